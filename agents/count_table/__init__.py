"""A count table with value iteration: the control that has no network, no factors and no imagined data."""
