"""Learned skills at 25 Hz: a cloned policy, macro-actions that it executes, and a flat baseline."""
