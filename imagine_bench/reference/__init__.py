"""The results of the thesis, as data."""
