"""The whole task in physics: six holes, approach and contact, in increments or in moves."""
