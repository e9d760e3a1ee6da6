"""What is learned in: the environments by name, and feature extractors for their images."""
