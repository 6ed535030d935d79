"""Fit of the kernel model, with widths, penalties and variances from held-out groups."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.soft_tissue._kernel_expert_fit import fit_expert
from jointfit_daemon.calibration.soft_tissue._kernel_trend_fit import fit_trend, unseen_trend
from jointfit_daemon.calibration.soft_tissue._leverage_variance_fit import measure_spread
from jointfit_daemon.calibration.soft_tissue._posture_weights import weigh_postures
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import (
    KernelModel,
    equal_weights,
    fuse,
    mix_corrections,
    model_inputs,
)

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.soft_tissue._segment_training import SegmentTraining


BLOCKS = 3
"""Number of held-out blocks of a single trial. Few long blocks are used, so that each contains
movement that the other blocks do not contain.
"""


def fit_kernel(training: SegmentTraining) -> KernelModel:
    """Return the kernel model of one segment."""
    return fit_kernel_with_residuals(training)[0]


def fit_kernel_with_residuals(training: SegmentTraining) -> tuple[KernelModel, Array]:
    """Fit both experts and the trend; held-out groups determine widths, penalties and variances.

    Groups are blocks in time and, with several trials, whole trials.

    Returns
    -------
    model : KernelModel
    residuals : ndarray, shape (w n, 3)
        Residual of every frame with its group held out, in segment axes, rad. The w groupings
        follow each other.

    Raises
    ------
    ValueError
        The segment has no neighboring segment.
    """
    if training.q_other is None:
        raise ValueError("the kernel model needs a sensor of the neighboring segment")

    count = len(training.sensors)
    mean = fuse(training.sensors, equal_weights(count))
    rho = rotation.log(rotation.multiply(rotation.conjugate(mean), training.q_reference))
    u = model_inputs(training.sensors, mean, training.q_other)

    # The groupings are blocks in time and, with several trials, whole trials.
    ways = [list(training.folds(BLOCKS))]
    if training.movements > 1:
        ways.append([training.trials == label for label in np.unique(training.trials)])

    weights = weigh_postures(u)
    plain = fit_expert(u, rho, count, ways, weights, tilted=False)
    tilted = fit_expert(u, rho, count, ways, weights, tilted=True)

    # Compute the residuals of held-out frames and their distance from the training range.
    lines = [unseen_trend(u, rho, groups, weights) for groups in ways]
    unseen = list(zip(lines, plain.unseen, plain.ratios, tilted.unseen, tilted.ratios, strict=True))
    residuals = [rho - mix_corrections(*each) for each in unseen]
    distances = [np.maximum(a_ratio, b_ratio) for _, _, a_ratio, _, b_ratio in unseen]

    model = KernelModel(
        sensors=count,
        plain=plain.expert,
        tilted=tilted.expert,
        trend=fit_trend(u, rho, weights),
        spread=measure_spread(distances, residuals, weights),
        residual_sd=_sd(residuals[-1]),
        mean_sd=_sd(rho),
    )
    return model, np.concatenate(residuals)


def _sd(residuals: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=1)) / 3.0))
