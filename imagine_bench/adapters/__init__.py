"""Our tasks through the interfaces of other packages; each adapter is one file, imported only when asked for."""
