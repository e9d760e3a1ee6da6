"""Kinematics of the 3-RRS and the Delta, usable without the environment.

Import the module you need: :mod:`~coop_env.kinematics.rrs`, :mod:`~coop_env.kinematics.delta` and
:mod:`~coop_env.kinematics.rotations` take batches; the ``*_kernels`` modules hold the scalar
formulas that numba compiles and everything else calls.
"""
