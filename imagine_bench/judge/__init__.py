"""Hold what agents imagine, plan and predict against the exact truth of the rules."""
