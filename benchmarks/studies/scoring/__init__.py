"""Stored policies, and what others bring, on the test episodes."""
