"""The tasks at 25 Hz: hand commands instead of macro-actions, judged by the same rules."""
