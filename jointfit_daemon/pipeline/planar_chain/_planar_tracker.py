"""Joint positions and stick figure of a planar chain in operation.

A joint connects two body parts. If a part has at least two markers, its pose is known. In the
coordinates of this part, each marker of the adjacent part moves on a circle about the joint. A
running circle fit, in which older frames lose weight, estimates the center and predicts its error.
A part at the end of the chain needs only one marker. Source: Akbarifar et al., Iranian Journal of
Biomedical Engineering 15 (2021), 1-11.

Invariant: the result depends neither on an IMU nor on a calibration.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from math import exp, inf, isfinite, nan
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation import (
    BodyPoses,
    CenterEstimate,
    JointSide,
    fuse_centers,
    joint_trajectory,
)
from jointfit_daemon.center_of_rotation.planar import RunningCircle, plane_of
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import MAX_FIT_RMS_M, body_parts, vector
from jointfit_daemon.model import PlanarJoint, Stick, StickFigure
from jointfit_daemon.pipeline.events import Notice, NoticeKind
from jointfit_daemon.pipeline.planar_chain._movement_plane import PlaneEstimator
from jointfit_daemon.pipeline.planar_chain._planar_marker_monitor import PlanarMarkerMonitor
from jointfit_daemon.pipeline.planar_chain._planar_segment import (
    LEAST_MARKERS,
    MissingPose,
    PlanarSegment,
)
from jointfit_daemon.pipeline.planar_chain._reversal_detector import AdjacentMarker, PlanarPose
from jointfit_daemon.timing.alignment import RateDivider

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Chain, MocapFrame, MocapLayout, Vector
    from jointfit_daemon.pipeline.events import Output

LEARNED_HZ = 20.0
"""Number of frames per second in the running fits. Joints rotate by a few degrees between two of
these frames."""
FITTED_HZ = 2.0
"""Number of center estimates per second."""
OTHER_PLANE_COS = 0.9962
"""Cosine of 5°. If the angle between two planes is larger, the centers are estimated again. In a
plane with an error of 5°, the circles are compressed by 0.4 %."""
FARTHEST_M = 1000.0
"""Distance from the origin beyond which a marker counts as missing, m."""


@dataclass(slots=True)
class _Side:
    """Estimator of a joint center in the coordinates of one of the two body parts."""

    parent: str
    """Body part in whose coordinates the center is estimated."""
    child: str
    """The other body part."""
    circles: list[RunningCircle]
    """One circle fit for each marker of the other body part."""
    estimate: CenterEstimate | None = None
    radii: list[float] = field(default_factory=list)
    """Radius of the circle of each marker, m; NaN if the circle fit of the marker is refused."""

    def clear(self) -> None:
        """Discard all frames and the estimate."""
        self.estimate, self.radii = None, []
        for circle in self.circles:
            circle.clear()

    def feed(self, pose: PlanarPose | None, child: NDArray[np.complex128]) -> None:
        """Process one frame; `child` contains the markers of the other part in the plane, m."""
        if pose is None:
            local = np.full(len(child), complex(np.nan, np.nan))
        else:
            local = (child - pose.origin) * np.conj(pose.turn)
        for circle, z in zip(self.circles, local, strict=True):
            circle.feed(float(z.real), float(z.imag))

    def fit(self) -> None:
        """Estimate the center from all frames so far."""
        each = [circle.estimate() for circle in self.circles]
        self.radii = [float(e.radii[0]) if e.refused is None else nan for e in each]
        found = each[0] if len(each) == 1 else fuse_centers(each)
        if found.refused is None and MAX_FIT_RMS_M < found.residual < inf:
            reason = (
                f"the distance of its markers varies by {1e3 * found.residual:.0f} mm RMS, "
                f"expected at most {1e3 * MAX_FIT_RMS_M:g} mm: check that they are on this segment"
            )
            found = replace(found, refused=reason)
        self.estimate = found


@dataclass(slots=True)
class _Joint:
    name: str
    parts: tuple[str, str]
    sides: list[_Side] = field(default_factory=list)


class PlanarTracker:
    """Estimates each joint between two body parts of which at least one has two or more markers.

    Parameters
    ----------
    chain : Chain
        The limb. Joints between adjacent parts with markers are estimated.
    markers : mapping of str to tuple of str
        Names of the markers of every body part.
    rate_hz : float
        Largest number of stick figures per second; above 0.
    memory_s : float
        Time constant with which older frames lose weight, s.
    """

    def __init__(
        self, chain: Chain, markers: Mapping[str, tuple[str, ...]], rate_hz: float, memory_s: float
    ) -> None:
        self._given = chain, rate_hz, memory_s
        self._forgetting = exp(-1.0 / (LEARNED_HZ * memory_s))
        parts = [part for part in body_parts(chain) if part is not None and part in markers]
        self._parts = {part: PlanarSegment(markers[part]) for part in parts}
        self._joints = [
            _Joint(chain.joints[i], (a, b))
            for i, (a, b) in enumerate(pairwise(body_parts(chain)))
            if a is not None and b is not None and {a, b} <= self._parts.keys()
        ]
        self._names = [name for part in self._parts.values() for name in part.markers]
        self._markers = PlanarMarkerMonitor(self._names)
        self._estimator = PlaneEstimator(len(self._names), self._forgetting)
        self._plane = self._estimator.estimate()
        self._basis: Array | None = None
        self._shown, self._learned = RateDivider(rate_hz), RateDivider(LEARNED_HZ)
        self._fitted = RateDivider(FITTED_HZ)
        self._layout: MocapLayout | None = None
        self._columns: list[int] = []

    def serves(self, chain: Chain, rate_hz: float, memory_s: float) -> bool:
        """Return whether this tracker was created with these settings."""
        return self._given == (chain, rate_hz, memory_s)

    def add_frame(self, t_ns: int, frame: MocapFrame) -> list[Output]:
        """Return the stick figure if it is due for this live frame, and notices."""
        learned, shown = self._learned.is_due(t_ns), self._shown.is_due(t_ns)
        if not (learned or shown):
            return []

        # Collect the k markers of every part, m, shape (k, 3); NaN where missing.
        if frame.layout is not self._layout:
            self._layout = frame.layout
            column = {name: k for k, name in enumerate(frame.layout.markers)}
            self._columns = [column.get(name, -1) for name in self._names]
        padded = np.concatenate((frame.markers, np.full((1, 3), np.nan)))
        found = padded[self._columns]
        possible = (np.abs(found) < FARTHEST_M).all(axis=1, keepdims=True)
        found = np.where(possible, found, np.nan)
        ends = np.cumsum([len(part.markers) for part in self._parts.values()])[:-1]
        measured = dict(zip(self._parts, np.split(found, ends), strict=True))

        notices: list[Output] = []
        fitted = learned and self._fitted.is_due(t_ns)
        if learned:
            self._estimator.feed(np.concatenate(list(measured.values())))
        if fitted:
            notices = self._update_plane(t_ns)

        poses = {} if self._basis is None else self._poses(t_ns, measured)
        if learned and poses:
            self._learn(measured, poses, fit=fitted)
        planar = poses if self._plane.normal is not None else {}
        notices += self._markers.update(t_ns, np.isfinite(found).all(axis=1), planar)
        return [*notices, self._figure(t_ns, frame, measured, poses)] if shown else notices

    def _update_plane(self, t_ns: int) -> list[Output]:
        """Use the first estimated plane, or a new plane if the movement has changed its plane."""
        self._plane = plane = self._estimator.estimate()
        if plane.normal is None:
            return []
        before = None if self._basis is None else np.cross(*self._basis.T)
        if before is not None and abs(float(before @ plane.normal)) > OTHER_PLANE_COS:
            return []
        self._basis = plane_of(plane.normal)
        for part in self._parts.values():
            part.clear()
        for joint in self._joints:
            joint.sides = [
                _Side(a, b, [RunningCircle(forgetting=self._forgetting)
                             for _ in self._parts[b].markers])
                for a, b in (joint.parts, joint.parts[::-1])
                if len(self._parts[a].markers) >= LEAST_MARKERS
            ]  # fmt: skip
        what = "found" if before is None else "changed: the joint centres are estimated again"
        data = {"state": "plane", "normal": [round(float(x), 4) for x in plane.normal]}
        text = f"plane of movement {what}"
        return [Notice(t_ns, NoticeKind.MARKER, "plane", text, data=data)]

    def _in_plane(self, points: Array) -> NDArray[np.complex128]:
        basis = self._basis
        if basis is None:
            return np.full(len(points), complex(np.nan, np.nan))
        flat = points @ basis
        return np.asarray(flat[:, 0] + 1j * flat[:, 1])

    def _poses(
        self, t_ns: int, measured: Mapping[str, Array]
    ) -> dict[str, PlanarPose | MissingPose]:
        """Return the pose of every part with two or more markers, or why it has no pose."""
        flat = {name: self._in_plane(points) for name, points in measured.items()}
        poses = {
            name: part.pose(t_ns, flat[name], partial(self._adjacent, name, flat))
            for name, part in self._parts.items()
            if len(part.markers) >= LEAST_MARKERS
        }
        for name, pose in poses.items():
            if isinstance(pose, MissingPose) and pose.renewed:
                for joint in self._joints:
                    for side in joint.sides if name in joint.parts else ():
                        side.clear()
        return poses

    def _adjacent(
        self, part: str, flat: Mapping[str, NDArray[np.complex128]]
    ) -> list[AdjacentMarker]:
        """Return the markers on adjacent parts that have an accepted joint center in `part`."""
        return [
            AdjacentMarker(complex(*side.estimate.center), radii, complex(z))
            for joint in self._joints
            for side in joint.sides
            if side.parent == part
            if side.estimate is not None and side.estimate.refused is None
            if (radii := tuple(filter(isfinite, side.radii)))
            for z in flat[side.child]
        ]

    def _learn(
        self,
        measured: Mapping[str, Array],
        poses: Mapping[str, PlanarPose | MissingPose],
        *,
        fit: bool,
    ) -> None:
        for joint in self._joints:
            for side in joint.sides:
                pose, other = poses[side.parent], poses.get(side.child)
                wrong = isinstance(other, MissingPose) and other.faulty
                known = pose if isinstance(pose, PlanarPose) and not wrong else None
                side.feed(known, self._in_plane(measured[side.child]))
                if fit:
                    side.fit()

    # --- output ------------------------------------------------------------------------------

    def _figure(
        self,
        t_ns: int,
        frame: MocapFrame,
        measured: Mapping[str, Array],
        poses: Mapping[str, PlanarPose | MissingPose],
    ) -> StickFigure:
        joints = {joint.name: self._position(joint, measured, poses) for joint in self._joints}
        normal = None if self._basis is None else np.cross(*self._basis.T)
        plane = self._plane
        return StickFigure(
            frame.number,
            t_ns,
            None if normal is None else vector(normal),
            plane.off_plane,
            plane.refused if normal is None else None,
            tuple(joints.values()),
            tuple(self._stick(part, measured[part], joints) for part in self._parts),
        )

    def _position(
        self,
        joint: _Joint,
        measured: Mapping[str, Array],
        poses: Mapping[str, PlanarPose | MissingPose],
    ) -> PlanarJoint:
        """Return the joint's position in this frame, from each part with a pose and a center."""
        basis = self._basis
        if basis is None:
            return PlanarJoint(joint.name, None, None, None, self._plane.refused)
        normal = np.cross(*basis.T)
        sides, reasons = [], []
        for side in joint.sides:
            pose, estimate = poses[side.parent], side.estimate
            if isinstance(pose, MissingPose):
                reasons.append(f"{side.parent}: {pose.reason}")
            elif estimate is None or estimate.refused is not None:
                why = "no center yet" if estimate is None else estimate.refused
                reasons.append(f"{side.child} about {joint.name}, seen from {side.parent}: {why}")
            else:
                # The position along the normal is taken from the markers.
                part, along = self._parts[side.parent], measured[side.parent] @ normal
                t = basis @ (pose.origin.real, pose.origin.imag) + normal * np.nanmean(along)
                q = rotation.exp(np.angle(pose.turn) * normal[None])
                frame = BodyPoses(q, np.asarray(t)[None])
                sides.append(JointSide(frame, basis, part.flat_template, part.rms, estimate))
        found = joint_trajectory(sides, 1)
        if not np.isfinite(found.positions).all():
            return PlanarJoint(joint.name, None, None, None, "; ".join(reasons))
        arc = max(side.estimate.arc for side in sides)
        position, error = vector(found.positions[0]), float(found.error[0])
        return PlanarJoint(joint.name, position, error, arc, None)

    def _stick(self, part: str, seen: Array, joints: Mapping[str, PlanarJoint]) -> Stick:
        """Return the ends of a segment: two joints, or marker and joint at an end of the chain."""
        ends: list[Vector | None] = [
            joints[joint.name].position for joint in self._joints if part in joint.parts
        ]
        if len(ends) == 1:
            here = np.flatnonzero(np.isfinite(seen).all(axis=1))
            marker = vector(seen[here[0]]) if here.size else None
            first = part == self._joints[0].parts[0]
            ends = [marker, *ends] if first else [*ends, marker]
        return Stick(part, tuple(ends))
