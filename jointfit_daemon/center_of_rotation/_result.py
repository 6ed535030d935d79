"""Result type of all estimators of a center of rotation.

Invariant: `unseen` lists the directions without information. If a center is unusable, `refused`
contains the reason. No field of a usable estimate is NaN.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import inf, sqrt
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.arrays import Array


@dataclass(frozen=True, slots=True)
class CenterEstimate:
    """Estimate of the point that is fixed in both the parent and the child segment.

    All estimators return this type. A `JointCenter` of the calibration contains a `CenterEstimate`,
    and combines it with the other joints of the chain and with the prior that the subject stood
    upright in the static pose.
    """

    method: str
    """Name of the estimator: ``hyper``, ``sphere``, ``score``, ..."""
    center: Array
    """Position in the parent's coordinates, m, shape (d,), d = 2 (plane) or 3 (space)."""
    covariance: Array
    """Covariance of the position, m², shape (d, d); zero along the directions in `unseen`."""
    noise: float
    """Standard deviation of each coordinate of a point, estimated from the residuals, m."""
    residual: float
    """RMS residual, m. For SCoRE and SARA a residual is the distance between the joint positions
    computed from the two segments. For other methods it is the deviation of a marker's distance
    from the radius.
    """
    radii: Array
    """Distance of each marker from the center, m, shape (k,)."""
    arc: float
    """Angle covered by the markers about the center, rad."""
    bound: float
    """Cramér-Rao bound of the RMS error, m; inf if a direction is unobserved. The noise is assumed
    to have the size `noise` and to be independent from frame to frame. The bound depends on the
    movement, not on the method.
    """
    conditioning: float
    """T, the radius divided by the largest standard error of the center. To first order, T is also
    the curvature of the path divided by its standard error. A center with T below 6 is not usable.
    """
    frames: int
    effective_frames: float
    """Effective number of frames. It is smaller than `frames` if successive residuals are
    correlated, or if old frames have smaller weights than new frames.
    """
    unseen: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """Unit vectors of the unobserved directions, shape (u, d)."""
    axis: Array | None = None
    """Unit axis of a hinge in the parent's coordinates, shape (3,); None if there is no hinge."""
    axis_sd: float | None = None
    """Standard deviation of the axis in each direction perpendicular to it, rad; None if unknown.
    """
    leverage: Array | None = None
    """Covariance of the center per m² of variance of the radial soft-tissue artefact, shape (d, d);
    None if not computed. The artefact repeats with posture, so more frames do not reduce this
    covariance."""
    flags: tuple[str, ...] = ()
    """Findings about the data, e.g. ``orientation_inconsistent``. A flag about a marker, such as
    ``marker_off:2``, has the index of the marker; `name_flagged_markers` replaces it by the name.
    """
    within95: float | None = None
    """Squared Mahalanobis distance eᵀC⁻¹e that 95 % of the errors e of this method do not exceed; C
    is the covariance. If None, use the quantile of the chi-square distribution.
    """
    refused: str | None = None
    """Cause and remedy if the center must not be used; None if the center is usable."""

    @property
    def rms_error(self) -> float:
        """Return the predicted RMS error √tr(covariance), m; inf if a direction is unobserved."""
        if len(self.unseen) > 0:
            return inf
        return sqrt(max(float(np.trace(self.covariance)), 0.0))


def refusal(method: str, d: int, frames: int, reason: str) -> CenterEstimate:
    """Return a refused estimate without information in any direction, with the reason."""
    return CenterEstimate(
        method=method,
        center=np.full(d, np.nan),
        covariance=np.zeros((d, d)),
        noise=inf,
        residual=inf,
        radii=np.zeros(0),
        arc=0.0,
        bound=inf,
        conditioning=0.0,
        frames=frames,
        effective_frames=0.0,
        unseen=np.eye(d),
        refused=reason,
    )


def name_flagged_markers(estimate: CenterEstimate, names: Sequence[str]) -> CenterEstimate:
    """Replace the index of a marker in each flag by the marker's name.

    `names` contains the names in the order of the indices.
    """
    flags = []
    for flag in estimate.flags:
        kind, separator, index = flag.partition(":")
        flags.append(f"{kind}:{names[int(index)]}" if separator else flag)
    return replace(estimate, flags=tuple(flags))
