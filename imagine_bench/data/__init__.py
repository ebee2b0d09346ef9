"""Datasets of real episodes: collected by any policy, written and read in three formats, one content hash for all."""
