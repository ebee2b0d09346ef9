"""Continuous control in other forms: with goals, and by keys."""
