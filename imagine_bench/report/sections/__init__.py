"""The sections of a bench of agents."""
