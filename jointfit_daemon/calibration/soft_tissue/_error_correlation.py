r"""How far two neighbouring segments err alike about the axis that limbs flex about.

.. math:: \rho = \frac{\sum_i e_{1i} e_{2i}}{\sqrt{\sum_i e_{1i}^2 \sum_i e_{2i}^2}}, \qquad
          \sigma_{flexion}^2 = \sigma_1^2 + \sigma_2^2 - 2 \rho\, \sigma_1 \sigma_2

with e what is left over of each segment about its x on frames that its fit has not seen. Both
models look at the same joint: where they are wrong, they are so together, mostly one against the
other.

Law: held-out frames only; where nothing is known the errors are taken to be independent.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.soft_tissue._kernel_fit import learn_kernel
from jointfit_daemon.calibration.soft_tissue._limb_fit import mean_of
from jointfit_daemon.calibration.soft_tissue._segment_training import FEWEST_FRAMES, SegmentTraining
from jointfit_daemon.limb_model import neighbor

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.soft_tissue._limb_fit import LimbTraining
    from jointfit_daemon.limb_model import Method
    from jointfit_daemon.model import Chain

MOST = 0.9
"""Neither errors that are quite the same nor quite opposite are believed."""


def error_correlations(chain: Chain, training: LimbTraining, method: Method) -> Mapping[str, float]:
    """Return rho of every inner joint; empty for methods other than ``anchored``.

    Joints whose segments were not seen whole together in 30 frames are left out.
    """
    if method != "anchored":
        return {}
    found = {}
    for i, joint in enumerate(chain.joints[1:-1]):
        columns = [_columns(chain, training, k) for k in (i, i + 1)]
        whole = np.all([np.isfinite(q).all(axis=1) for q in (*columns[0], *columns[1])], axis=0)
        if np.count_nonzero(whole) < FEWEST_FRAMES:
            continue
        trials = None if training.trials is None else training.trials[whole]
        upper, lower = (
            SegmentTraining.of([q[whole] for q in sensors], near[whole], truth[whole], trials)
            for *sensors, near, truth in columns
        )
        found[joint] = error_correlation(upper, lower)
    return found


def error_correlation(first: SegmentTraining, second: SegmentTraining) -> float:
    """Return rho of two segments that were trained on the same frames, upper one first."""
    a, b = (learn_kernel(training)[1][:, 0] for training in (first, second))
    size = float(np.sqrt(np.sum(a**2) * np.sum(b**2)))
    return 0.0 if size == 0.0 else min(max(float(np.sum(a * b)) / size, -MOST), MOST)


def _columns(chain: Chain, training: LimbTraining, i: int) -> list[Array]:
    """Return the sensors of segment i, its neighbour as they see it, and its reference."""
    sensors = [training.sensors[name] for name in chain.sensors[i]]
    near = mean_of(training, neighbor(chain, i))
    return [*sensors, near, training.reference[chain.segments[i]]]
