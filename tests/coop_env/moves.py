"""The twelve moves as increments, for the tests of all that moves by them."""

import numpy as np

MOVES = np.kron(np.eye(6, dtype=int), [[1], [-1]])
"""(12, 6): one step up, then one down, along each axis in turn."""
