"""Pictures of an episode, and an episode in the browser."""
