"""Index arrays of a chain model, such as parents, columns and levels, computed once per model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jointfit_daemon.kinematics.chains._coupled_joint import CoupledCurve

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chains._model import ChainModel

Index = NDArray[np.intp]

LEVI: NDArray[np.float64] = np.zeros((3, 9))
"""``(v @ LEVI).reshape(3, 3)`` is the matrix of the cross product with v."""
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    LEVI[_i, 3 * _k + _j], LEVI[_i, 3 * _j + _k] = 1.0, -1.0
LEVI.setflags(write=False)


@dataclass(frozen=True, slots=True)
class ChainLayout:
    """Arrays that every computation on a chain uses, for S segments and nq degrees of freedom."""

    nq: int
    levels: tuple[tuple[Index | slice, Index | slice], ...]
    """Segments with a parent, grouped by depth, and their parents."""
    free: Index | slice
    """Indices of the free segments."""
    corners: Array
    """Translations to the joint centers in the axes of the parents, as transforms of shape (S, 4,
    4)."""
    has_own_centers: bool
    """Whether a joint center differs from the origin of its segment."""
    center: Array
    """Joint centers in segment axes, m, shape (S, 3); zero for free segments."""
    segment_of: Index
    """Segment of each degree of freedom, shape (nq,)."""
    columns: tuple[tuple[int, slice], ...]
    """Index and degrees of freedom of each segment."""
    turns: Array
    """Axis (x, y, z, 0) of each rotational degree of freedom, and a point (x, y, z, 1) on the axis,
    in segment axes, shape (nq, 4, 2). The axis is zero for translations and coupled joints.
    """
    shifts: Index
    """Indices of the degrees of freedom that translate a free segment."""
    shift_twists: Array
    """Twists of the translations in `shifts`, shape (len(shifts), 6)."""
    spread: Array
    """Matrix, shape (nq, 3 S). ``step @ spread`` contains the rotation vectors by which a step of
    the state (`apply_step`) rotates each segment relative to its parent. Rows of translations and
    coupled joints are zero.
    """
    below: Array
    """Matrix with 1 where segment j is segment i or a descendant of segment i, shape (S, S)."""
    moves: Array
    """Matrix with 1 where a degree of freedom moves a segment, shape (S, nq)."""
    lower: Array
    """Matrix, shape (nq, nq), with 1 on and below the diagonal if the segment of the column is the
    segment of the row or an ancestor of this segment.
    """
    strictly_lower: Array
    """Matrix `lower` without its diagonal."""
    coupled: tuple[tuple[int, int, CoupledCurve], ...]
    """Segment, column and curve of each coupled joint."""


def layout_of(model: ChainModel) -> ChainLayout:
    """Return the layout of a model, cached in the model."""
    kept = model.__dict__.get("_layout")
    if not isinstance(kept, ChainLayout):
        kept = _layout(model)
        # cached like the properties of the model, which is immutable
        model.__dict__["_layout"] = kept
    return kept


def _layout(model: ChainModel) -> ChainLayout:
    joints = [s.joint for s in model.segments]
    parents = model.parents.tolist()
    is_free = np.array([j.kind == "free" for j in joints])
    columns = [(i, k) for i, c in enumerate(model.columns) for k in range(c.stop - c.start)]
    axes = np.zeros((len(columns), 3))
    for row, (i, k) in enumerate(columns):
        if k < 3 and joints[i].kind != "coupled":
            axes[row] = joints[i].axis if joints[i].kind == "hinge" else np.eye(3)[k]

    segment_of = np.array([i for i, _ in columns], dtype=np.intp)
    shifts = np.array([row for row, (_, k) in enumerate(columns) if k > 2], dtype=np.intp)
    center = np.where(is_free[:, None], 0.0, [j.center for j in joints])
    below = np.eye(len(parents))
    for i in reversed(range(len(parents))):
        if parents[i] >= 0:
            below[parents[i]] = np.maximum(below[parents[i]], below[i])

    corners = np.tile(np.eye(4), (len(joints), 1, 1))
    corners[:, :3, 3] = np.where(is_free[:, None], 0.0, [j.center_in_parent for j in joints])
    spread = np.zeros((len(columns), len(parents), 3))
    spread[np.arange(len(columns)), segment_of] = axes

    turns = np.zeros((len(columns), 4, 2))
    turns[:, :3, 0], turns[:, :3, 1], turns[:, 3, 1] = axes, center[segment_of], 1.0
    lower = np.tril(below[np.ix_(segment_of, segment_of)].T)

    return ChainLayout(
        nq=len(columns),
        levels=_levels(parents),
        free=_index(np.flatnonzero(is_free).tolist()),
        corners=corners,
        has_own_centers=bool(center.any()),
        center=center,
        segment_of=segment_of,
        columns=tuple(enumerate(model.columns)),
        turns=turns,
        shifts=shifts,
        shift_twists=np.tile(np.eye(6)[3:], (len(shifts) // 3, 1)),
        spread=spread.reshape(len(columns), -1),
        below=below,
        moves=below.T[:, segment_of],
        lower=lower,
        strictly_lower=np.tril(lower, -1),
        coupled=tuple(
            (i, c.start, CoupledCurve.through(j.path))
            for i, (j, c) in enumerate(zip(joints, model.columns, strict=True))
            if j.kind == "coupled"
        ),
    )


def _levels(parents: list[int]) -> tuple[tuple[Index | slice, Index | slice], ...]:
    depth: list[int] = []
    for parent in parents:
        depth.append(0 if parent < 0 else depth[parent] + 1)
    return tuple(
        (_index(level), _index([parents[i] for i in level]))
        for d in range(1, max(depth) + 1)
        if (level := [i for i, at in enumerate(depth) if at == d])
    )


def _index(items: list[int]) -> Index | slice:
    """Return evenly spaced indices as a slice, which avoids a copy."""
    step = items[1] - items[0] if len(items) > 1 else 1
    if items and step > 0 and items == list(range(items[0], items[-1] + 1, step)):
        return slice(items[0], items[-1] + 1, step)
    return np.array(items, dtype=np.intp)
