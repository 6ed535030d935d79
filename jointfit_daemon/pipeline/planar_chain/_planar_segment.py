"""Pose of one segment in the plane of movement, from two or more markers.

The template of the markers is the first frame that shows all of them. The origin of the segment is
the mean of the template. Complex numbers x + iy represent points of the plane in the coordinates of
its basis.
"""

from __future__ import annotations

from cmath import exp, phase
from dataclasses import dataclass, field
from math import sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.model import MarkerFlag
from jointfit_daemon.name_lists import join_words
from jointfit_daemon.pipeline.planar_chain._reversal_detector import (
    Labels,
    PlanarPose,
    ReversalDetector,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from jointfit_daemon.pipeline.planar_chain._reversal_detector import AdjacentMarker

LOOSE_M = 0.012
"""RMS residual of the template above which the markers are displaced relative to each other, m. Two
markers reach it if their distance changes by 24 mm, which exceeds soft-tissue artefact."""
LEAST_MARKERS = 2
"""Number of markers that define a pose in a plane."""
_MEMORY = 0.02
"""Weight of a new frame in two running means: the squared residual, and the share of frames with
displaced markers."""
_MOST_LOOSE = 0.1
"""Share of frames with displaced markers above which the segment has no pose."""


class MissingPose(NamedTuple):
    """Reason why a segment has no pose in one frame."""

    reason: str
    faulty: bool = False
    """Whether the visible markers are faulty, so that no joint may be estimated from them."""
    flag: MarkerFlag | None = None
    """Fault of the labels or places of the markers, if it is known."""
    markers: tuple[str, ...] = ()
    """Visible markers, in a frame with a fault."""
    renewed: bool = False
    """Whether the present labels are accepted from the next frame on. The joint centers must then
    be estimated again."""


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
    _labels: ReversalDetector = field(default_factory=ReversalDetector)
    _since_pose: NDArray[np.bool_] | None = None
    """Markers that have been visible in all frames since the last pose."""

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
        """Discard the template, because the basis of the plane or the labels have changed."""
        self.template, self._since_pose = None, None
        self._labels = ReversalDetector()
        self._square = self._loose = 0.0

    def pose(
        self,
        t_ns: int,
        z: NDArray[np.complex128],
        adjacent: Callable[[], list[AdjacentMarker]] = list,
    ) -> PlanarPose | MissingPose:
        """Return the pose in one frame, or the reason why there is no pose.

        Parameters
        ----------
        t_ns
            Instant of the frame.
        z
            Positions of the k markers in the plane, m, shape (k,); NaN where missing.
        adjacent
            Function that returns the markers of adjacent parts with known joint centers.
        """
        seen = np.isfinite(z)
        if self.template is None and seen.all():
            self.template = z - z.mean()
        if self.template is None or seen.sum() < LEAST_MARKERS:
            hidden = [name for name, here in zip(self.markers, seen, strict=True) if not here]
            reason = f"{', '.join(hidden)} not visible"
            return MissingPose(reason, faulty=self._is_doubtful(seen))

        at, template = z[seen].mean(), self.template[seen]
        middle = template.mean()
        product = complex(((z[seen] - at) * (template - middle).conj()).sum())
        turn = exp(1j * phase(product))
        origin = complex(at - turn * middle)
        square = float((np.abs(z[seen] - origin - turn * template) ** 2).mean())
        names = tuple(np.array(self.markers)[seen].tolist())
        loose = sqrt(square) > LOOSE_M
        self._loose += _MEMORY * (float(loose) - self._loose)
        if loose or self._loose > _MOST_LOOSE:
            what = f"{' and '.join(names)} do not move together: check that they are on one segment"
            return MissingPose(what, True, MarkerFlag.MISFIT, names)

        pose, turned = PlanarPose(turn, origin), PlanarPose(-turn, complex(at + turn * middle))
        labels = self._labels.update(
            t_ns, (pose, turned), adjacent, reversible=len(names) == LEAST_MARKERS
        )
        if labels is not Labels.CORRECT:
            return self._unused(labels, names)
        self._square += _MEMORY * (square - self._square)
        self._since_pose = np.ones_like(seen)
        return pose

    def _is_doubtful(self, seen: NDArray[np.bool_]) -> bool:
        """Return whether the visible markers of a frame without pose may have exchanged labels."""
        if self._since_pose is None:
            return False
        self._since_pose = self._since_pose & seen
        changed = bool((seen & ~self._since_pose).any())
        return changed or self._labels.state is not Labels.CORRECT

    def _unused(self, labels: Labels, names: tuple[str, ...]) -> MissingPose:
        """Return the reason why a pose that fits the markers is not used."""
        both = join_words(names)
        if labels is Labels.EXCHANGED:
            reason = f"{both} look exchanged: correct their labels"
            return MissingPose(reason, True, MarkerFlag.EXCHANGED, names)
        if labels is Labels.UNDECIDED:
            reason = (
                f"{both} were hidden and may have been exchanged: show the markers of the adjacent "
                "segments"
            )
            return MissingPose(reason, True, markers=names)
        self.clear()
        reason = f"{both}: the joint centres are estimated again with the present labels"
        return MissingPose(reason, True, markers=names, renewed=True)
