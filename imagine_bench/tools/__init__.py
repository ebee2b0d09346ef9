"""Commands beside the bench: describe, doctor, new, play, and the sets of ``make data``."""
