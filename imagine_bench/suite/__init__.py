"""The ladder: a fixed list of experiments, each of which turns one dial of a world, and one score in each."""
