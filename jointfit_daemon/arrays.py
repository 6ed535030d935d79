"""The array type of the project."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Real numbers in double precision; the shape and the unit are in the docstring of each use."""
