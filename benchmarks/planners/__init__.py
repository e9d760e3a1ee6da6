"""Planners: methods that know the model and compute a move sequence before they act."""
