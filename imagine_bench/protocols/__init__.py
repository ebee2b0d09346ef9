"""Protocols of comparisons, the runs they are made of, and the types of task that have them."""
