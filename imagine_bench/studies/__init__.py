"""Studies: one comparison, one factor changed at a time."""
