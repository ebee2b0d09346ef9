"""Scenes composed with dm_control.mjcf."""
