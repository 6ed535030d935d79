r"""Linear trend of the soft-tissue artefact, used outside the training range.

.. math:: T_j = c_j + \sum_i \beta_{ij} d_{ij} + \gamma_j v_{o(j)}, \qquad T_z = 0

for the axes j = x, y, which are horizontal in the static pose. c, β and γ are coefficients.
:math:`d_{ij}` is the rotation about axis j from the first sensor to the further sensor i. v is the
tilt, and :math:`v_{o(j)}` is its component that a rotation about axis j changes, with o(x) = y and
o(y) = x. The term with d is equivalent to other weights of the sensors in the mean. About z, the
long axis of the segment, a constant correction and a heading error are indistinguishable, so there
is no trend. The trend does not depend on headings.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.limb_model._kernel_expert import LARGEST

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

    Row = tuple[float, ...]

LEVEL_AXES = (0, 1)


def trend(rows: tuple[Row, Row], u: Array) -> Array:
    """Return the trend of every frame, rad, shape (n, 3), limited to ±`LARGEST`."""
    found = np.zeros((len(u), 3))
    table = np.array(rows)
    found[:, LEVEL_AXES] = table[:, 0] + u @ table[:, 1:].T
    return np.clip(found, -LARGEST, LARGEST)
