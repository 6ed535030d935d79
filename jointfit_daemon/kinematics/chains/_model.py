r"""Chain models: a tree of rigid segments on joints, with markers fixed to the segments.

The data are immutable, and parents precede children. The pose of segment i is computed from the
pose of its parent p,

.. math:: R_i = R_p A_i, \qquad t_i = t_p + R_p\, c_p - R_i\, c_i

R is a rotation to the world, t an origin, and c the joint center in parent (p) and segment (i). The
joint rotation :math:`A_i` of a ``ball`` joint is arbitrary. For a ``hinge`` it is
:math:`A_{rest}\exp(a\theta)` with axis a and angle θ. A ``free`` joint has an arbitrary rotation
and origin. A ``coupled`` joint has one coordinate, which moves :math:`A_i` and :math:`c_p` along a
path. Axes and centers are in segment axes, in metres.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Literal

import numpy as np

from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion, Vector

JointKind = Literal["free", "ball", "hinge", "coupled"]
DEGREES_OF_FREEDOM: dict[JointKind, int] = {"free": 6, "ball": 3, "hinge": 1, "coupled": 1}
Sample = tuple[float, float, float, float, float, float, float, float]
_ORIGIN: Vector = (0.0, 0.0, 0.0)
_UNIT_TOLERANCE = 1e-6
_FEWEST_SAMPLES = 4


class InvalidChainModelError(ValueError):
    """Segments, joints and markers do not form a chain; the message lists all reasons."""


@dataclass(frozen=True, slots=True)
class Joint:
    """Joint between a segment and its parent."""

    kind: JointKind = "free"
    center_in_parent: Vector = _ORIGIN
    """Joint center in the axes of the parent or, without a parent, of the world, m. A free joint
    does not use it.
    """
    center: Vector = _ORIGIN
    """Joint center in the axes of the segment, m. A free joint does not use it."""
    axis: Vector = (1.0, 0.0, 0.0)
    """Unit axis of a hinge in segment axes. Positive rotations about it are right-handed."""
    rest: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """Rotation q_parent_segment of a hinge at angle zero. For a ball joint it is the initial
    rotation of the search if no markers determine the rotation.
    """
    limits: tuple[float, float] | None = None
    """Least and greatest angle of a hinge, or coordinate of a coupled joint, rad. None if
    unlimited.
    """
    path: tuple[Sample, ...] = ()
    """Samples of a coupled joint. A sample consists of the coordinate, rad, q_parent_segment, and
    the shift that is added to ``center_in_parent`` in the parent's axes, m. Poses between samples
    are interpolated by cubic splines.
    """


@dataclass(frozen=True, slots=True)
class Segment:
    """One rigid body of the chain."""

    name: str
    parent: str | None = None
    """Name of the parent; None is the world."""
    joint: Joint = Joint()


@dataclass(frozen=True, slots=True)
class Marker:
    """Point fixed to a segment."""

    name: str
    segment: str
    position: Vector
    """Position in segment axes, m."""
    weight: float = 1.0
    """Weight of the squared marker error; 0 excludes the marker."""
    locked: tuple[bool, bool, bool] = (False, False, False)
    """Coordinates in segment axes that a refinement must not change."""


@dataclass(frozen=True)
class ChainModel:
    """Chain of segments, with parents first, and the markers of the segments.

    The class has no slots, because derived arrays are cached properties.

    Raises
    ------
    InvalidChainModelError
        The model has duplicate names, unknown parents, segments or joint kinds, parents after
        children, a free joint with a parent, axes or rotations that do not have unit length, empty
        limits, an invalid path, negative weights, values that are not finite, or no segments.
    """

    segments: tuple[Segment, ...]
    markers: tuple[Marker, ...]
    name: str = "chain"

    def __post_init__(self) -> None:
        names = [s.name for s in self.segments]
        wrong = _duplicates("segment", names) if names else ["no segments"]
        for i, s in enumerate(self.segments):
            if s.parent is not None and s.parent not in names[:i]:
                known = "after it" if s.parent in names else "unknown"
                wrong.append(f"segment {s.name!r}: its parent {s.parent!r} is {known}")
            wrong += [f"segment {s.name!r}: {reason}" for reason in _wrong_joint(s)]
        wrong = [*wrong, *_wrong_markers(self.segments, self.markers)]
        if wrong:
            raise InvalidChainModelError(f"{self.name}: {'; '.join(wrong)}")

    @cached_property
    def nq(self) -> int:
        """Number of degrees of freedom."""
        return sum(DEGREES_OF_FREEDOM[s.joint.kind] for s in self.segments)

    @cached_property
    def segment_names(self) -> tuple[str, ...]:
        """Names of the segments, in the order of all arrays over segments."""
        return tuple(s.name for s in self.segments)

    @cached_property
    def marker_names(self) -> tuple[str, ...]:
        """Names of the markers, in the order of all arrays over markers."""
        return tuple(m.name for m in self.markers)

    @cached_property
    def parents(self) -> NDArray[np.intp]:
        """Index of each segment's parent, -1 for the world; shape (S,)."""
        index = {name: i for i, name in enumerate(self.segment_names)} | {None: -1}
        return np.array([index[s.parent] for s in self.segments], dtype=np.intp)

    @cached_property
    def marker_segments(self) -> NDArray[np.intp]:
        """Index of each marker's segment; shape (M,)."""
        index = {name: i for i, name in enumerate(self.segment_names)}
        return np.array([index[m.segment] for m in self.markers], dtype=np.intp)

    @cached_property
    def positions(self) -> Array:
        """Marker positions in segment axes, m; shape (M, 3)."""
        return np.array([m.position for m in self.markers], dtype=np.float64).reshape(-1, 3)

    @cached_property
    def weights(self) -> Array:
        """Weights of the markers, shape (M,)."""
        return np.array([m.weight for m in self.markers], dtype=np.float64)

    @cached_property
    def locked(self) -> NDArray[np.bool_]:
        """Marker coordinates that a refinement must not change; shape (M, 3)."""
        return np.array([m.locked for m in self.markers], dtype=np.bool_).reshape(-1, 3)

    @cached_property
    def columns(self) -> tuple[slice, ...]:
        """Columns of each segment in a step of the state; rotations precede translations."""
        ends = np.cumsum([0, *(DEGREES_OF_FREEDOM[s.joint.kind] for s in self.segments)]).tolist()
        return tuple(slice(a, b) for a, b in pairwise(ends))

    def with_markers(self, positions: ArrayLike) -> ChainModel:
        """Return the model with other marker positions in segment axes, m, shape (M, 3)."""
        new = np.asarray(positions, dtype=np.float64).reshape(len(self.markers), 3).tolist()
        moved = (
            replace(m, position=(x, y, z)) for m, (x, y, z) in zip(self.markers, new, strict=True)
        )
        return replace(self, markers=tuple(moved))

    def with_locks(self, locked: Mapping[str, tuple[bool, bool, bool]]) -> ChainModel:
        """Return the model with other locks for some markers, by marker name."""
        return replace(
            self,
            markers=tuple(
                replace(m, locked=locked[m.name]) if m.name in locked else m for m in self.markers
            ),
        )

    def scaled(self, factors: Mapping[str, ArrayLike]) -> ChainModel:
        """Return the model with segments scaled by one factor or by one factor per axis.

        The keys of `factors` are segment names. Scaling changes the markers, the joint center of
        the segment, and the joint centers of its children.
        """
        unknown = set(factors) - set(self.segment_names)
        if unknown:
            raise InvalidChainModelError(f"{self.name}: no segments {', '.join(sorted(unknown))}")

        def stretch(segment: str | None, point: Vector) -> Vector:
            x, y, z = (np.asarray(point) * np.asarray(factors.get(segment or "", 1.0))).tolist()
            return (x, y, z)

        def joint(s: Segment) -> Joint:
            j = s.joint
            return replace(
                j,
                center_in_parent=stretch(s.parent, j.center_in_parent),
                center=stretch(s.name, j.center),
                path=tuple((*at[:5], *stretch(s.parent, at[5:])) for at in j.path),
            )

        return replace(
            self,
            segments=tuple(replace(s, joint=joint(s)) for s in self.segments),
            markers=tuple(
                replace(m, position=stretch(m.segment, m.position)) for m in self.markers
            ),
        )


def _duplicates(what: str, names: Sequence[str]) -> list[str]:
    return [f"{what} {name!r} twice" for name, n in Counter(names).items() if n > 1]


def _wrong_joint(s: Segment) -> list[str]:
    j, wrong = s.joint, []
    if j.kind not in DEGREES_OF_FREEDOM:
        wrong.append(f"joint {j.kind!r}, expected one of {', '.join(DEGREES_OF_FREEDOM)}")
    if j.kind == "free" and s.parent is not None:
        wrong.append("a free joint must not have a parent")
    if not np.isfinite([*j.center_in_parent, *j.center, *j.axis, *j.rest]).all():
        wrong.append("its joint contains values that are not finite")

    for what, values in (("axis", j.axis), ("rest", j.rest)):
        if abs(float(np.linalg.norm(values)) - 1.0) > _UNIT_TOLERANCE:
            wrong.append(f"{what} {values} is not of length 1")
    if j.limits is not None and not j.limits[0] < j.limits[1]:
        wrong.append(f"limits {j.limits}, expected a lower limit below the upper limit")
    return wrong + _wrong_path(j)


def _wrong_path(j: Joint) -> list[str]:
    if j.kind != "coupled":
        return [f"a path, but its joint is {j.kind!r}"] if j.path else []
    if len(j.path) < _FEWEST_SAMPLES:
        return [f"a coupled joint needs a path of {_FEWEST_SAMPLES} samples, has {len(j.path)}"]
    path = np.array(j.path)
    if not np.isfinite(path).all():
        return ["its path is not finite"]
    rising = (np.diff(path[:, 0]) > 0.0).all()
    wrong = [] if rising else ["the coordinate of its path must increase from sample to sample"]
    if (np.abs(np.linalg.norm(path[:, 1:5], axis=1) - 1.0) > _UNIT_TOLERANCE).any():
        wrong.append("a quaternion of its path is not of length 1")
    return wrong


def _wrong_markers(segments: tuple[Segment, ...], markers: tuple[Marker, ...]) -> list[str]:
    names = {s.name for s in segments}
    wrong = _duplicates("marker", [m.name for m in markers])
    for m in markers:
        if m.segment not in names:
            wrong.append(f"marker {m.name!r}: no segment {m.segment!r}")
        if not np.isfinite(m.position).all():
            wrong.append(f"marker {m.name!r}: position {m.position} is not finite")
        if not 0.0 <= m.weight < float("inf"):
            wrong.append(f"marker {m.name!r}: weight {m.weight}, expected 0 or more, finite")
    return wrong


def rest_rotations(model: ChainModel) -> Array:
    """Return the rest rotation of every joint, R_parent_segment, shape (S, 3, 3)."""
    return rotation.to_matrix(np.array([s.joint.rest for s in model.segments]))
