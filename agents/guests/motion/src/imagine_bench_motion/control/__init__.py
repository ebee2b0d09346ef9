"""Continuous control in other forms: with goals, by keys, and recorded."""
