"""Arrow puzzles: that of the thesis (chapter 5) and its family."""
