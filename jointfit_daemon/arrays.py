"""The array type of the project."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Real numbers in double precision. Each docstring that uses the type states shape and unit."""
