"""Programs as world models, agents that plan in them, and a writer of programs that has no language model."""
