"""Facts of a world before any agent acts in it, from its rules and from its frames."""
