r"""What a correction falls back to outside of its training: a straight line, a few numbers an axis.

.. math:: T_j = c_j + \sum_i \beta_{ij} d_{ij} + \gamma_j v_{o(j)}, \qquad T_z = 0

about the axes j = x, y, which are level in the static pose: a constant, the disagreement d of each
further sensor about the same axis (that is, other weights of the sensors), and the tilt that turns
about it. It is the mean of two fits, one without tilt and one with it: where movements are few, the
bend of a joint and the tilt of a segment come together, and neither fit alone carries over.

Law: relative rotations and tilt only, so headings change nothing. About z, the long axis of the
segment, no sensor can tell a constant from a heading: there is no trend.
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
    """Return T of every frame, rad, shape (n, 3); no component exceeds that of a correction."""
    found = np.zeros((len(u), 3))
    table = np.array(rows)
    found[:, LEVEL_AXES] = table[:, 0] + u @ table[:, 1:].T
    return np.clip(found, -LARGEST, LARGEST)
