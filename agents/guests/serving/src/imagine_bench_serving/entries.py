"""The registry lines of players that play over HTTP: readers are told each frame in words, viewers are shown it."""

from __future__ import annotations

from imagine_bench.registry.entries import players_named

READER, TRAINED_READER = players_named(
    "reader", "A program, such as a language model, to which 'imagine-bench serve' tells each frame in words."
).values()
VIEWER, TRAINED_VIEWER = players_named(
    "viewer", "A program, such as a language model, to which 'imagine-bench serve' shows frames as PNG."
).values()
