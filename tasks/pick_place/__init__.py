"""Pick-and-place with a human who changes their mind (thesis, chapter 3)."""
