"""Rainbow beside SB3's DQN and sb3-contrib's QRDQN on small tasks that have nothing of robots."""
