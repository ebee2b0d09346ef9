"""Simulated tasks: MuJoCo scenes, macro-actions executed by an arm, exact rules."""
