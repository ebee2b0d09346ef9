"""Simulated tasks: MuJoCo scenes, macro-actions executed by an arm, exact rules."""

from .graphics import choose_platform

choose_platform()  # before MuJoCo is first imported
