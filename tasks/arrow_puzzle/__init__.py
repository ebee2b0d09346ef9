"""The arrow puzzle (thesis, chapter 5)."""
