"""Continuous control in other forms: with goals, by keys, recorded, and as demonstrations."""
