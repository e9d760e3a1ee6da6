"""Action masks, in sb3-contrib's conventions, from the environment to the replay buffer."""
