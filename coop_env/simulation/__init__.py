"""The task's state, and what a move makes of it."""
