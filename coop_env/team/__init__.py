"""The same task with both robots moving at once: by two agents, or by one that commands both."""
