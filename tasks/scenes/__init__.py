"""Scenes composed with MuJoCo's own ``MjSpec``."""
