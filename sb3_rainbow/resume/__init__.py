"""Runs that go on exactly where they were cut off."""
