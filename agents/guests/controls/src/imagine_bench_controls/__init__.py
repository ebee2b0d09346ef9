"""Control agents as guests of imagine_bench: each shows how much one part of an agent is worth."""
