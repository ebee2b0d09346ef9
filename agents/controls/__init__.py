"""Controls: the DQN and its imagination with one ingredient given or added, to say where a gain comes from."""
