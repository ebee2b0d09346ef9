"""Agents of Stable-Baselines3, trained by the library's own loop."""
