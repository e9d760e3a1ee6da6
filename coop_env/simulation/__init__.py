"""The task's state, and its change by a move."""
