"""Many environments moved by one kernel call, as SB3's ``VecEnv`` and Gymnasium's ``VectorEnv``."""
