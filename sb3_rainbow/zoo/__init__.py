"""Rainbow in rl-baselines3-zoo and on the Hugging Face hub; needs the extra ``zoo``."""
