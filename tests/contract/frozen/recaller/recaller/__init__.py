"""Recalls what followed a macro-action, and imagines by that."""
