"""Agents with memory, for worlds whose frames do not show all that matters: a recurrent DQN, recurrent imagination."""
