"""Where stored policies of the contact task look for ``Guide``: SB3 pickled it by this name."""

from benchmarks.protocol.presets import Guide

__all__ = ["Guide"]
