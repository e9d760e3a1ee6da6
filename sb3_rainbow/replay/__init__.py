"""Prioritized n-step replay."""
