"""Hip and knee centers estimated from recorded trials, compared with a musculoskeletal model.

Invariant: the estimators receive only the markers of two neighbouring segments: no static trial, no
regression equation, no model. An error is the distance between an estimate and the mean position of
the model's joint center, in the coordinates of the parent segment.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path  # noqa: TC003 - the cache's key
from typing import TYPE_CHECKING

import numpy as np

from bench.subjects.model_joint_centers import ModelTrial, gait2354, opencap
from jointfit_daemon.center_of_rotation import estimate_center
from jointfit_daemon.tools.center.trial import ParentFrameMotion, reduce

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.center_of_rotation import CenterEstimate

OPENCAP = ("squats1", "STS1", "DJ1", "walking1")
_PELVIS = ("r.ASIS", "L.ASIS", "r.PSIS", "L.PSIS")
_THIGHS = {side: tuple(f"{side}_thigh{i}" for i in range(1, 5)) for side in ("r", "L")}
_SHANKS = {
    "r": ("r_sh2", "r_sh3", "r_sh4", "r_shank_antsup"),
    "L": ("L_sh2", "L_sh3", "L_shank_antsup"),
}
_GAIT = ("Upper", "Front", "Rear")


@dataclass(frozen=True, slots=True)
class ModelJoint:
    """Joint to estimate: its name, its name in the model, and the markers of its two segments."""

    name: str
    model: str
    parent: tuple[str, ...]
    child: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class EstimatedCenters:
    """Estimates of one joint center, and the center in the model."""

    joint: ModelJoint
    reduced: ParentFrameMotion
    model: NDArray[np.float64]
    """Mean center of the model over its frames, in parent coordinates, m."""
    wander: float
    """RMS distance of the model's center from its mean position, m. Soft-tissue artefact moves the
    parent's markers, and therefore the center in parent coordinates."""
    estimates: dict[str, CenterEstimate]
    """Estimates, by method."""

    def off(self, method: str) -> float:
        """Return the distance between estimate and model, m."""
        return float(np.linalg.norm(self.estimates[method].center - self.model))

    def off_axis(self, method: str) -> float:
        """Return the distance perpendicular to the joint axis, m.

        Along the axis of a hinge, the center is undetermined.
        """
        gap = self.estimates[method].center - self.model
        axis = hinge(self.reduced)
        return float(np.linalg.norm(gap - axis * (gap @ axis)))

    def told_across(self, method: str) -> float:
        """Return the predicted RMS error perpendicular to the axis, m."""
        axis = hinge(self.reduced)
        across = np.eye(3) - np.outer(axis, axis)
        spread = across @ self.estimates[method].covariance @ across
        return float(np.sqrt(max(np.trace(spread), 0.0)))


def hinge(reduced: ParentFrameMotion) -> NDArray[np.float64]:
    """Return the main axis about which the child rotates: a unit vector in parent coordinates."""
    points = reduced.movement.points
    assert points is not None
    whole = points[np.isfinite(points).all(axis=(1, 2))]
    steps = whole - whole.mean(axis=0)
    # The markers of a hinge move in planes perpendicular to its axis, so the axis is the direction
    # of least variance.
    _, vectors = np.linalg.eigh(np.einsum("tki,tkj->ij", steps, steps))
    return np.asarray(vectors[:, 0])


def opencap_joints() -> tuple[ModelJoint, ...]:
    sides = (("right", "r", "r"), ("left", "L", "l"))
    return tuple(
        joint
        for word, S, s in sides
        for joint in (
            ModelJoint(f"{word} hip", f"hip_{s}", _PELVIS, _THIGHS[S]),
            ModelJoint(f"{word} knee", f"walker_knee_{s}", _THIGHS[S], _SHANKS[S]),
        )
    )


def gait_joints() -> tuple[ModelJoint, ...]:
    pelvis = ("R.ASIS", "L.ASIS", "V.Sacral")
    found = []
    for word, side in (("right", "R"), ("left", "L")):
        thigh = tuple(f"{side}.Thigh.{place}" for place in _GAIT)
        shank = tuple(f"{side}.Shank.{place}" for place in _GAIT)
        found.append(ModelJoint(f"{word} hip", f"hip_{side.lower()}", pelvis, thigh))
        found.append(ModelJoint(f"{word} knee", f"knee_{side.lower()}", thigh, shank))
    return tuple(found)


@cache
def judged(data: Path, trial: str, methods: tuple[str, ...]) -> tuple[EstimatedCenters, ...]:
    """Estimate all joints of `trial`, which is ``gait2354`` or one of `OPENCAP`."""
    if trial == "gait2354":
        model, joints = gait2354(data), gait_joints()
    else:
        model, joints = opencap(data, trial), opencap_joints()
    return tuple(_judge(model, joint, methods) for joint in joints)


def _judge(model: ModelTrial, joint: ModelJoint, methods: tuple[str, ...]) -> EstimatedCenters:
    reduced = reduce(model.markers, joint.parent, joint.child, None)
    frames = model.frames
    poses = type(reduced.poses)(reduced.poses.q[frames], reduced.poses.t[frames])
    local = poses.to_body(model.centers[joint.model][:, None])[:, 0]
    mean = np.nanmean(local, axis=0)
    wander = float(np.sqrt(np.nanmean(((local - mean) ** 2).sum(axis=1))))
    found = {method: estimate_center(reduced.movement, method) for method in methods}
    return EstimatedCenters(joint, reduced, mean, wander, found)
