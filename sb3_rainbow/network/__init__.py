"""What is computed: the Q-network, its noisy layers, targets and losses."""
