"""What can be known of a world before any agent acts in it, from its rules and from what its frames show."""
