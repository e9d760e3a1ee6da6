"""One run from start to end: the harness, its processes, checkpoints and store."""
