"""Joint co-design: the 3-RRS is chosen for what the team achieves, not for its workspace alone."""
