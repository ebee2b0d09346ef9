"""What the kept test episodes of a bench prove: that its tables hold, and why its agents failed."""
