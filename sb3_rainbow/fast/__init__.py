"""Shortcuts of an update: everything works without this folder, slower."""
