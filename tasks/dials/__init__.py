"""What makes a task harder in one respect, each 0 by default: one file a dial, for any task's rules."""
