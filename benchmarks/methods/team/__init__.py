"""Two robots that move at once: their environment under test, and networks with a head for each."""
