"""The test protocol: every method on the same episodes."""
