"""Fit of one segment model by any method; `limb_model.Method` lists the methods."""

from __future__ import annotations

from typing import TYPE_CHECKING, get_args

from jointfit_daemon.calibration.soft_tissue._aligned_fit import fit_aligned
from jointfit_daemon.calibration.soft_tissue._kernel_fit import fit_kernel
from jointfit_daemon.calibration.soft_tissue._mean_fit import best_single, fit_mean, plain_mean
from jointfit_daemon.calibration.soft_tissue._patent_fit import fit_patent
from jointfit_daemon.calibration.soft_tissue._segment_training import SegmentTraining
from jointfit_daemon.limb_model import Method

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from jointfit_daemon.limb_model import SegmentModel


def fit_segment(
    method: Method,
    sensors: Sequence[ArrayLike],
    q_other: ArrayLike | None,
    q_reference: ArrayLike,
    trials: ArrayLike | None = None,
) -> SegmentModel:
    """Fit a model of one segment for one set of sensors.

    Parameters
    ----------
    method : {"anchored", "patent12", "patent6", "markley", "mean", "single"}
        ``anchored`` is the kernel model; without a neighbor it is equal to the weighted mean.
        ``patent12`` and ``patent6`` are two interpretations of the regression of the patent.
        ``markley`` aligns each sensor by a heading and a mount, and weights sensors by their
        errors. ``mean`` weights all sensors equally. ``single`` uses only the best sensor.
    sensors : sequence of array_like, shape (n, 4)
        q_world_segment of each sensor with its static alignment; any number of sensors.
    q_other : array_like, shape (n, 4), or None
        Orientation of the neighboring segment, from one sensor or from the mean of several sensors.
    q_reference : array_like, shape (n, 4)
        q_world_segment from optical markers in the same world. Frames with any NaN are ignored.
    trials : array_like of int, shape (n,), optional
        Movement label of each frame; one movement by default. Generalization between movements
        determines the size of the correction and its standard deviation.

    Raises
    ------
    ValueError
        There is no sensor, fewer than 30 frames are complete, or the method is unknown.
    """
    training = SegmentTraining.of(sensors, q_other, q_reference, trials)
    if method == "patent12" or method == "patent6":  # noqa: PLR1714 - narrows the literal
        return fit_patent(method, training)
    if method == "anchored" and training.q_other is not None:
        return fit_kernel(training)
    if method == "anchored":
        return fit_mean(training)
    if method == "mean":
        return plain_mean(training)
    if method == "markley":
        return fit_aligned(training)
    if method == "single":
        return best_single(training)
    raise ValueError(f"method {method!r} is unknown; known: {', '.join(get_args(Method))}")
