"""The named errors of the environment; each is a ``ValueError`` whose message names the mend."""

from __future__ import annotations


class ArgumentError(ValueError):
    """A constructor argument of the environment is unknown, out of range or of the wrong kind."""


class RewardError(ArgumentError):
    """An unknown reward, an unknown key of ``reward_kwargs``, or a scale that makes no sense."""


class ActionError(ValueError):
    """An action that is not one of the action space, or of no agent, or of one that is done."""


class ResetOptionError(ValueError):
    """A reset option that is unknown, malformed, or names a state that cannot be taken."""


class StateError(ValueError):
    """A snapshot that does not fit the environment it is loaded into."""
