"""The physics twin of both robots, with real contact, in MuJoCo (extra ``physics``).

:mod:`~coop_env.physics.model` writes the MJCF, :mod:`~coop_env.physics.twin` moves it,
:mod:`~coop_env.physics.validation` holds it against the kinematics, and
:mod:`~coop_env.physics.env` has the two tasks on it.
"""
