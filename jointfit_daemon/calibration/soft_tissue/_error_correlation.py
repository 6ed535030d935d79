r"""Correlation of the errors of two neighboring segments about the flexion axis.

.. math:: \rho = \frac{\sum_i e_{1i} e_{2i}}{\sqrt{\sum_i e_{1i}^2 \sum_i e_{2i}^2}}, \qquad
          \sigma_{flexion}^2 = \sigma_1^2 + \sigma_2^2 - 2 \rho\, \sigma_1 \sigma_2

where e is the residual of each segment about its x axis on held-out frames. Both models use the
same joint rotation, so their errors are correlated, mostly negatively. Without data the errors are
assumed to be independent.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.soft_tissue._kernel_fit import fit_kernel_with_residuals
from jointfit_daemon.calibration.soft_tissue._limb_fit import mean_of
from jointfit_daemon.calibration.soft_tissue._segment_training import FEWEST_FRAMES, SegmentTraining
from jointfit_daemon.limb_model import inner_joints, neighbor

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.calibration.soft_tissue._limb_fit import LimbTraining
    from jointfit_daemon.limb_model import Method
    from jointfit_daemon.model import Chain

MOST = 0.9
"""Limit of the absolute correlation, because perfectly correlated errors are implausible."""


def joint_error_correlations(
    chain: Chain, training: LimbTraining, method: Method
) -> Mapping[str, float]:
    """Return rho of every inner joint; empty for methods other than ``anchored``.

    Joints whose two segments have fewer than 30 common complete frames are absent.
    """
    if method != "anchored":
        return {}
    found = {}
    for joint in inner_joints(chain):
        # Collect sensors, mean of the neighbor, and reference of each segment.
        columns = [
            [
                *(training.sensors[name] for name in chain.sensors[k]),
                mean_of(training, neighbor(chain, k)),
                training.reference[chain.segments[k]],
            ]
            for k in (joint.proximal, joint.distal)
        ]
        whole = np.all([np.isfinite(q).all(axis=1) for q in (*columns[0], *columns[1])], axis=0)
        if np.count_nonzero(whole) < FEWEST_FRAMES:
            continue

        trials = None if training.trials is None else training.trials[whole]
        upper, lower = (
            SegmentTraining.of([q[whole] for q in sensors], near[whole], truth[whole], trials)
            for *sensors, near, truth in columns
        )
        found[joint.name] = error_correlation(upper, lower)
    return found


def error_correlation(first: SegmentTraining, second: SegmentTraining) -> float:
    """Return rho of two segments trained on the same frames, proximal segment first."""
    a, b = (fit_kernel_with_residuals(training)[1][:, 0] for training in (first, second))
    size = float(np.sqrt(np.sum(a**2) * np.sum(b**2)))
    return 0.0 if size == 0.0 else min(max(float(np.sum(a * b)) / size, -MOST), MOST)
