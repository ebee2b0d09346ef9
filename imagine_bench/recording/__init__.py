"""Pictures and Rerun recordings of episodes, plans and imagined rollouts; the only folder that knows Rerun."""
