"""Several sensors on one segment, some of them dead or alive: which model, and how it is fitted.

Law: the one door to the segment models. A fit is given bone-aligned sensors in the world of the
reference; what is trained for one set of sensors is used for exactly that set.
"""

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
        ``anchored`` without a neighbour gives the weighted mean: it has nothing else to look at.
        ``markley`` turns each sensor by a heading and a mount of its own, and weighs them by what
        they err; ``mean`` weighs all sensors alike; ``single`` takes the best one alone.
    sensors : sequence of array_like, shape (n, 4)
        q_world_segment as each sensor says it through its static mount. Any number: means
        weigh each, the regressions have a column for each, ``anchored`` a difference for each.
    q_other : array_like, shape (n, 4), or None
        The same of the neighbouring segment: of one sensor, or the mean of several.
    q_reference : array_like, shape (n, 4)
        q_world_segment by optics, same world. Frames with NaN anywhere are left out.
    trials : array_like of int, shape (n,), optional
        Which trial, that is kind of movement, each frame belongs to; one if None. What carries
        over from one to another decides how much is corrected, and how sure it is.

    Raises
    ------
    ValueError
        No sensor, fewer than 30 complete frames, or an unknown method.
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
    raise ValueError(f"method {method!r}; known: {', '.join(get_args(Method))}")
