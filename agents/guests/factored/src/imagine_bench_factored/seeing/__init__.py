"""From frames to values: nuisances are taken away, then regions and their values are found."""
