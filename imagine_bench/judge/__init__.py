"""Compare the imagination, plans and predictions of agents with the exact truth of the rules."""
