"""Pose of one segment in the plane of movement, from two or more markers.

The template of the markers is the first frame that shows all of them. The origin of the segment is
the mean of the template. Complex numbers x + iy represent points of the plane in the coordinates of
its basis.
"""

from __future__ import annotations

from cmath import exp, phase
from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

LOOSE_M = 0.012
"""RMS residual of the template above which the markers are displaced relative to each other, m. Two
markers reach it if their distance changes by 24 mm, which exceeds soft-tissue artefact."""
LEAST_MARKERS = 2
"""Number of markers that define a pose in a plane."""
_EXCHANGE_RAD = 2.5
"""Rotation between two frames above which the labels must have been exchanged, rad."""
_EXCHANGE_NS = 200_000_000
"""Longest time between two frames for the check of exchanged labels, ns."""
_MEMORY = 0.02
"""Weight of a new frame in two running means: the squared residual, and the share of frames with
displaced markers."""
_MOST_LOOSE = 0.1
"""Share of frames with displaced markers above which the segment has no pose."""


class PlanarPose(NamedTuple):
    """Pose of a segment in the plane. A point z of the segment is at turn · z + origin."""

    turn: complex
    """Rotation as a complex number of absolute value 1."""
    origin: complex
    """Position of the segment's origin, m."""


class MissingPose(NamedTuple):
    """Reason why a segment has no pose in one frame."""

    reason: str
    faulty: bool = False
    """Whether the visible markers are faulty, so that no joint may be estimated from them."""


@dataclass(slots=True)
class PlanarSegment:
    """Estimates the pose of one segment in the plane."""

    markers: tuple[str, ...]
    template: NDArray[np.complex128] | None = None
    """Markers in the coordinates of the segment, m; None before the first frame with all
    markers."""
    _square: float = 0.0
    """Mean squared residual of the template fit, m²."""
    _loose: float = 0.0
    """Share of recent frames in which the markers are displaced relative to each other."""
    _angle: float | None = None
    _angle_ns: int = 0

    @property
    def rms(self) -> float:
        """RMS residual of the fit of the template, m."""
        return sqrt(self._square)

    @property
    def flat_template(self) -> NDArray[np.float64]:
        """Template in real coordinates, m, shape (k, 2) for k markers."""
        template = np.zeros(0) if self.template is None else self.template
        return np.column_stack((template.real, template.imag))

    def clear(self) -> None:
        """Discard the template, because the basis of the plane has changed."""
        self.template, self._angle = None, None
        self._square = self._loose = 0.0

    def pose(self, t_ns: int, z: NDArray[np.complex128]) -> PlanarPose | MissingPose:
        """Return the pose in one frame, or the reason why there is no pose.

        Parameters
        ----------
        t_ns
            Instant of the frame.
        z
            Positions of the k markers in the plane, m, shape (k,); NaN where missing.
        """
        seen = np.isfinite(z)
        if self.template is None and seen.all():
            self.template = z - z.mean()
        if self.template is None or seen.sum() < LEAST_MARKERS:
            hidden = [name for name, here in zip(self.markers, seen, strict=True) if not here]
            return MissingPose(f"{', '.join(hidden)} not visible")

        at, template = z[seen].mean(), self.template[seen]
        middle = template.mean()
        product = complex(((z[seen] - at) * (template - middle).conj()).sum())
        turn = exp(1j * phase(product))
        origin = complex(at - turn * middle)
        square = float((np.abs(z[seen] - origin - turn * template) ** 2).mean())
        names = " and ".join(np.array(self.markers)[seen].tolist())
        loose = sqrt(square) > LOOSE_M
        self._loose += _MEMORY * (float(loose) - self._loose)
        if loose or self._loose > _MOST_LOOSE:
            what = "do not move together: check that they are on one segment"
            return MissingPose(f"{names} {what}", faulty=True)
        if self._has_exchanged_labels(t_ns, phase(product)):
            return MissingPose(f"{names} look exchanged: correct their labels", faulty=True)
        self._square += _MEMORY * (square - self._square)
        return PlanarPose(turn, origin)

    def _has_exchanged_labels(self, t_ns: int, angle: float) -> bool:
        """Return whether exchanged labels have rotated the segment since the last frame."""
        before, self._angle = self._angle, angle
        recent = t_ns - self._angle_ns < _EXCHANGE_NS
        self._angle_ns = t_ns
        if before is None or not recent:
            return False
        exchanged = abs(phase(exp(1j * (angle - before)))) > _EXCHANGE_RAD
        if exchanged:
            self._angle = phase(-exp(1j * angle))  # the rotation of the segment with correct labels
        return exchanged
