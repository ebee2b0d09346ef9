"""World parameters: each makes any task harder in one respect, is 0 by default, and has a file of its own."""
