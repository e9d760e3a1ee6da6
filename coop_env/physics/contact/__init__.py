"""Insertion of one peg by feel: the task, its episodes, and its two environments."""
