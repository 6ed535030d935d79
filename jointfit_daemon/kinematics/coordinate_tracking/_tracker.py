"""Tracker that computes the coordinates of a chain state by state.

Invariant: the number of numerical steps per instant is bounded for every pose.
"""

from __future__ import annotations

from itertools import pairwise
from math import atan2, hypot, isnan, nan
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.chains import layout_of
from jointfit_daemon.kinematics.coordinate_tracking._closed_form import closed_form
from jointfit_daemon.kinematics.coordinate_tracking._numeric_inversion import (
    NumericInversion,
    pseudo_inverse,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chain_coordinates import JointCoordinates
    from jointfit_daemon.kinematics.chains import ChainModel, ChainState
    from jointfit_daemon.kinematics.coordinate_tracking._closed_form import ClosedForm

_LOCKED = 1e-3
"""Cosine of the second of three rotations below which the other two rotations are almost
indistinguishable. In this case the coordinates are searched numerically, starting from the values
of the preceding instant.
"""
_NO_OFFSET_M = 1e-12
_Row = tuple[float, float, float]
_Angles = tuple[_Row, tuple[_Row, _Row, _Row]]
"""Three angles, and their derivatives (rates) with respect to a step of the state."""


class CoordinateTracker:
    """Tracker of the coordinates of a chain, state by state.

    Except for full turns of angles, the result equals the result of `coordinate_table`. The
    coordinates of joints with a closed form are computed in closed form. For other joints a
    numerical search starts from the preceding values. Until the search ends, the coordinates of
    these joints are unknown.

    Parameters
    ----------
    model : ChainModel
        The chain.
    coordinates : tuple of JointCoordinates
        One entry for each segment, in the order of the model.
    """

    def __init__(self, model: ChainModel, coordinates: tuple[JointCoordinates, ...]) -> None:
        kinds = [segment.joint.kind for segment in model.segments]
        free = [i for i, kind in enumerate(kinds) if kind == "free"]
        curves = {segment: c for c, (segment, _, _) in enumerate(layout_of(model).coupled)}
        self._columns = [columns.start for columns in model.columns]
        self._axes = {
            i: np.asarray(segment.joint.axis)
            for i, segment in enumerate(model.segments)
            if segment.joint.kind == "hinge"
        }
        ends = np.cumsum([0, *(len(joint.names) for joint in coordinates)]).tolist()
        self._rows = [slice(a, b) for a, b in pairwise(ends)]

        # Part of the map from a step to coordinates that does not depend on the state, shape (K,
        # nq).
        self._rates = np.zeros((ends[-1], model.nq))
        self._coupled = [i for i, joint in enumerate(coordinates) if joint.pose is None]
        self._couplings = [curves[i] for i in self._coupled]
        for i in self._coupled:
            self._rates[ends[i], self._columns[i]] = 1.0

        forms = {i: closed_form(joint, kinds[i]) for i, joint in enumerate(coordinates)}
        closed = {i: form for i, form in forms.items() if form is not None}
        self._hinges = [i for i, form in closed.items() if len(form.angles) == 1]
        self._hinge_rows = np.array([ends[i] for i in self._hinges], dtype=np.intp)
        self._hinge_signs = np.array([closed[i].signs[0] for i in self._hinges])
        for i in self._hinges:
            rate = closed[i].signs[0] * (closed[i].basis[:, 0] @ self._axes[i])
            self._rates[ends[i], self._columns[i]] = rate

        self._threes = [i for i, form in closed.items() if len(form.angles) > 1]
        self._rotations = _Rotations.of(
            [closed[i] for i in self._threes],
            [ends[i] for i in self._threes],
            [self._columns[i] for i in self._threes],
            model.nq,
        )
        self._shifts = [
            shift
            for i, form in closed.items()
            if (shift := _Shift.of(form, i, free, ends[i], self._columns[i])) is not None
        ]
        for shift in self._shifts:
            column = shift.column + 3
            self._rates[shift.rows, column : column + 3] = shift.inverse

        self._closed = np.array([*self._hinges, *self._threes], dtype=np.intp)
        self._left = np.array([closed[i].left for i in self._closed.tolist()]).reshape(-1, 3, 3)
        self._right = np.array([closed[i].basis for i in self._closed.tolist()]).reshape(-1, 3, 3)
        self._open = [i for i in range(len(kinds)) if i not in closed and i not in self._coupled]
        self._free = {i: number for number, i in enumerate(free)}
        self._numeric = NumericInversion(
            {i: joint for i, joint in enumerate(coordinates) if joint.pose is not None}
        )
        self._last = np.full(ends[-1], np.nan)

    def read(self, state: ChainState, covariance: Array) -> tuple[Array, Array]:
        """Return the values of the K coordinates, rad and m, and their covariance.

        Parameters
        ----------
        state
            State at one instant.
        covariance
            Covariance of a step of the state, rad^2 and m^2, shape (nq, nq).

        Returns
        -------
        values
            Values, shape (K,), with angles within ±180°; NaN for a joint whose search has not
            ended, for example because its coordinates cannot describe the pose.
        covariance
            R C R^T, shape (K, K), with the derivatives R of the coordinates with respect to a step
            and the covariance C of the step; NaN for coordinates without a value.
        """
        values, rates = np.full(len(self._last), np.nan), self._rates.copy()
        for i, c in zip(self._coupled, self._couplings, strict=True):
            if state.couplings is not None:
                values[self._rows[i]] = state.couplings[0, c, 0]

        # In `_closed` the hinges precede the other joints.
        turned = (self._left @ state.rotations[0, self._closed] @ self._right).tolist()
        count = len(self._hinges)
        if count:
            angles = [atan2(M[2][1] - M[1][2], M[1][1] + M[2][2]) for M in turned[:count]]
            values[self._hinge_rows] = self._hinge_signs * angles
        waiting = self._open
        if self._threes:
            found = [_three_angles(M) for M in turned[count:]]
            self._rotations.write(found, values, rates)
            locked = [i for i, one in zip(self._threes, found, strict=True) if isnan(one[0][0])]
            waiting = [*waiting, *locked]
        for shift in self._shifts:
            shift.write(state, values, rates)
        if waiting:
            self._invert(waiting, state, values, rates)

        self._last = values
        unknown = np.isnan(values)
        return values, np.where(unknown[:, None] | unknown, np.nan, rates @ covariance @ rates.T)

    def _invert(self, numbers: list[int], state: ChainState, values: Array, rates: Array) -> None:
        """Write values and rates of joints without closed form; NaN if the values are unknown."""
        poses = {
            i: (
                state.rotations[0, i],
                state.origins[0, self._free[i]] if i in self._free else _NONE,
            )
            for i in numbers
        }
        before = {i: self._last[self._rows[i]] for i in numbers}
        last = {i: known for i, known in before.items() if np.isfinite(known).all()}
        found = self._numeric.invert(poses, last)
        for i in numbers:
            rows, column = self._rows[i], self._columns[i]
            values[rows], rates[rows] = nan, 0.0
            if i in found:
                values[rows], G = found[i]
                P = (
                    pseudo_inverse(G) @ self._axes[i][:, None]
                    if i in self._axes
                    else pseudo_inverse(G)
                )
                rates[rows, column : column + P.shape[1]] = P


class _Rotations(NamedTuple):
    """Arrays for the J joints that have three rotations with a closed form."""

    rows: NDArray[np.intp]
    """Indices of the rotation angles among the coordinates, shape (J, 3)."""
    signs: Array
    """Sign of each angle, shape (J, 3)."""
    basis: Array
    """Transposed axis matrices B^T, shape (J, 3, 3)."""
    cells: NDArray[np.intp]
    """Flat indices of the rates in an array of shape (K, nq); shape (J, 3, 3)."""

    @classmethod
    def of(
        cls, forms: list[ClosedForm], starts: list[int], columns: list[int], nq: int
    ) -> _Rotations:
        """Return the arrays of some joints with their first coordinates and columns."""
        angles = [[a + k for k in form.angles] for form, a in zip(forms, starts, strict=True)]
        rows = np.array(angles, dtype=np.intp).reshape(-1, 3)
        along = np.array(columns, dtype=np.intp)[:, None, None] + np.arange(3)
        return cls(
            rows,
            np.array([form.signs for form in forms]).reshape(-1, 3),
            np.array([form.basis.T for form in forms]).reshape(-1, 3, 3),
            rows[..., None] * nq + along,
        )

    def write(self, found: list[_Angles], values: Array, rates: Array) -> None:
        """Write the angles in `found` to `values`, and the derivatives of the angles to `rates`."""
        values[self.rows] = self.signs * [angles for angles, _ in found]
        by_step = np.array([rate for _, rate in found]) @ self.basis
        rates.ravel()[self.cells] = self.signs[..., None] * by_step


class _Shift(NamedTuple):
    """Translations of one free joint in closed form."""

    segment: int
    number: int
    """Number of the joint's segment among the free segments."""
    rows: NDArray[np.intp]
    """Indices of the translations among the coordinates."""
    column: int
    """First column of the segment in a step of the state."""
    inverse: Array
    start: Array
    center: Array | None
    """Joint center in segment axes, m; None if it is zero."""

    @classmethod
    def of(
        cls, form: ClosedForm, segment: int, free: list[int], first: int, column: int
    ) -> _Shift | None:
        """Return the translations of a free joint; None if the joint is not free.

        `first` is the index of the first coordinate of the joint, `column` the first column of its
        segment in a step.
        """
        if form.shift_inverse is None or form.start is None or form.center is None:
            return None
        center = form.center if np.abs(form.center).max() > _NO_OFFSET_M else None
        rows = np.array([first + k for k in form.shifts], dtype=np.intp)
        number = free.index(segment)
        return cls(segment, number, rows, column, form.shift_inverse, form.start, center)

    def write(self, state: ChainState, values: Array, rates: Array) -> None:
        """Write the translations, and their derivatives with respect to segment rotations."""
        moved = state.origins[0, self.number] - self.start
        if self.center is not None:
            # d(A c) = A (w x c) = -A [c]x w
            A, c = state.rotations[0, self.segment], self.center
            moved = moved - A @ c
            columns = slice(self.column, self.column + 3)
            rates[self.rows, columns] = self.inverse @ A @ rotation.skew(c)
        values[self.rows] = self.inverse @ moved


_NONE = np.zeros(0)


def _three_angles(M: list[list[float]]) -> _Angles:
    """Return the angles of M = Rx Ry Rz, and their derivatives with respect to a step.

    The step is in the axes after all three rotations. The angles are NaN if the second rotation is
    almost ±90°.
    """
    (m00, m01, sine), (_, _, m12), (_, _, m22) = M
    cosine = hypot(m00, m01)
    if cosine < _LOCKED:
        return (nan, nan, nan), (_ZERO, _ZERO, _ZERO)
    c, s, tangent = m00 / cosine, -m01 / cosine, sine / cosine
    angles = atan2(-m12, m22), atan2(sine, cosine), atan2(-m01, m00)
    first, second = (c / cosine, -s / cosine, 0.0), (s, c, 0.0)
    return angles, (first, second, (-tangent * c, tangent * s, 1.0))


_ZERO = (0.0, 0.0, 0.0)
