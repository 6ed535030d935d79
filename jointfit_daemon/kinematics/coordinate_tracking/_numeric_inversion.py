r"""Coordinates of joints without a closed form, by Gauss-Newton steps with numerical derivatives.

If a joint has fewer coordinates than degrees of freedom, a rotation remains that the coordinates
cannot describe. In this case the steps minimize the sine of the remaining rotation, not its angle.

Invariant: an instant takes at most `STEPS_PER_JOINT` steps per joint, plus `SPARE_STEPS` in total.
An inversion that needs more steps continues in the next instant. Until the inversion ends, the
coordinates of the joint are unknown.
"""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chain_coordinates import JointCoordinates

STEPS_PER_JOINT = 2
"""Number of steps per instant for each joint. It is sufficient for a joint whose coordinates at the
preceding instant are known.
"""
SPARE_STEPS = 6
"""Number of additional steps per instant, for joints that move fast or have unknown coordinates."""
_DIFFERENCE = 1e-5
"""Half the interval of a central difference, rad and m; the derivative has an error of about
1e-10."""
_RIDGE = 1e-12
"""Regularization that is added to G^T G, so that angles are finite at a gimbal lock. G is the
derivative of a step with respect to the coordinates.
"""
_MOST_ITERATIONS = 8
"""Largest number of iterations from one start. From the values of the preceding instant two
iterations are typical.
"""
_FARTHEST_STEP = 0.8
"""Largest step of an angle, rad. The limit is rarely reached, because most inversions start close
to the solution.
"""
_CLOSE = 1e-3
"""Distance to the pose, rad and m, below which the next step is the last. After this step the error
is about the square of the distance.
"""
_SETTLED = 1e-4
"""Step, rad and m, below which the search ends for a joint whose coordinates describe only a part
of the pose."""
_FARTHEST_MISFIT = 0.5
"""Largest rotation that the coordinates of a joint may leave undescribed, rad. A larger rotation
indicates a wrong solution."""
_SMALLEST_STEP = 1e-10
_QUARTERS = (0.0, 0.5 * np.pi, -0.5 * np.pi, np.pi)
"""Start angles of an inversion without values of a preceding instant, rad."""
_STEEP = 0.87
"""Start angle of the second of three rotations, rad. At 90 degrees, the first and the third
rotation would be about the same axis.
"""
_MOST_ANGLES = 3


class NumericInversion:
    """Computes the coordinates of several joints numerically from their poses, instant by instant.

    Parameters
    ----------
    joints
        Coordinates of the joints, by index of the segment.
    """

    def __init__(self, joints: Mapping[int, JointCoordinates]) -> None:
        self._joints = dict(joints)
        self._starts = {i: _starts(joint) for i, joint in self._joints.items()}
        """Start values of each joint, and the rotations at these values."""
        self._open: dict[int, Array] = {}
        """Current values of inversions that have not ended."""
        self._iterations = dict.fromkeys(self._joints, 0)
        """Number of iterations from the current start of each joint."""
        self._attempts = dict.fromkeys(self._joints, 0)
        """Number of failed starts of each joint since the last success."""
        self._turn = 0

    def invert(
        self, poses: Mapping[int, tuple[Array, Array]], last: Mapping[int, Array]
    ) -> dict[int, tuple[Array, Array]]:
        """Return values, shape (k,), and derivative, (3 or 6, k), of each joint that was solved.

        Parameters
        ----------
        poses
            Rotation, shape (3, 3), and origin of a free segment, m, (3,) or (0,), of each joint.
        last
            Values at the preceding instant, for each joint that was solved at that instant.
        """
        # Joints with values at the preceding instant are processed first. The other joints share
        # the remaining steps in turn.
        self._turn += 1
        numbers = sorted(poses)
        searching = [i for i in numbers if i not in last]
        first = self._turn % max(len(searching), 1)
        order = [i for i in numbers if i in last] + searching[first:] + searching[:first]

        found: dict[int, tuple[Array, Array]] = {}
        left = SPARE_STEPS + STEPS_PER_JOINT * len(order)
        for i in order:
            while left > 0:
                left -= 1
                ended = self._step(i, *poses[i], last.get(i))
                if ended is not None:
                    found[i] = ended
                    break
        return found

    def _step(
        self, i: int, A: Array, origin: Array, last: Array | None
    ) -> tuple[Array, Array] | None:
        """Take one step; return values and derivative if the step reaches the pose, else None."""
        joint = self._joints[i]
        values = self._open.get(i)
        if values is None:
            values = last if last is not None and not self._attempts[i] else self._start(i, A)

        self._iterations[i] += 1
        values, G, is_found = _take_step(joint, values, A, origin)
        if is_found:
            # Angles are limited to ±180°, and the second of three rotations to ±90°.
            values = values - 2.0 * np.pi * np.round(values / (2.0 * np.pi)) * joint.is_angle
            if joint.middle is None or abs(values[joint.middle]) <= 0.5 * np.pi + _CLOSE:
                self._open.pop(i, None)
                self._iterations[i] = self._attempts[i] = 0
                return values, G

        self._open[i] = values
        if is_found or self._iterations[i] == _MOST_ITERATIONS:
            del self._open[i]
            self._iterations[i] = 0
            self._attempts[i] += 1
        return None

    def _start(self, i: int, A: Array) -> Array:
        """Return the start values nearest to A or, after each failure, the next nearest values."""
        values, rotations = self._starts[i]
        nearest = np.argsort(-(rotations @ A.ravel()), kind="stable")
        return np.asarray(values[nearest[max(self._attempts[i] - 1, 0) % len(values)]])


def pseudo_inverse(G: Array) -> Array:
    """Return the pseudo-inverse of a derivative, which maps a step to coordinates."""
    square = G.T @ G + _RIDGE * np.eye(G.shape[-1])
    return np.asarray(np.linalg.solve(square, G.T))


def _starts(joint: JointCoordinates) -> tuple[Array, Array]:
    """Return start values of an inversion and the rotations at these values, shape (n, 9)."""
    turning = [k for k, is_angle in enumerate(joint.is_angle) if is_angle]
    tried = []
    for quarters in product(*[_QUARTERS] * min(len(turning), _MOST_ANGLES)):
        values = np.zeros(len(joint.names))
        values[turning[:_MOST_ANGLES]] = quarters
        if joint.middle is not None and abs(values[joint.middle]) >= 0.5 * np.pi:
            if values[joint.middle] >= np.pi:
                continue
            values[joint.middle] = np.copysign(_STEEP, values[joint.middle])
        tried.append(values)
    found = np.array(tried)
    if joint.pose is None:
        raise ValueError(f"{joint.segment}: its coordinate is part of the state")
    return found, joint.pose(found)[0].reshape(-1, 9)


def _take_step(
    joint: JointCoordinates, values: Array, A: Array, origin: Array
) -> tuple[Array, Array, bool]:
    """Return values after a step, the derivative, and whether the pose is reached."""
    if joint.pose is None:
        raise ValueError(f"{joint.segment}: its coordinate is part of the state")
    count, rows = len(values), 3 + len(origin)
    shift = _DIFFERENCE * np.eye(count)
    R, t = joint.pose(np.concatenate((values[None], values - shift, values + shift)))
    to_R = np.concatenate((A[None], R[1 + count :]))
    between = R[: 1 + count].swapaxes(-1, -2) @ to_R

    # The sine replaces the rotation angle. This is accurate for the small rotations of the last
    # steps.
    steps = np.zeros((1 + count, 6))
    steps[:, :3] = 0.5 * (between[:, (2, 0, 1), (1, 2, 0)] - between[:, (1, 2, 0), (2, 0, 1)])
    if len(origin):
        steps[:, 3:] = np.concatenate((origin[None], t[1 + count :])) - t[: 1 + count]
    missing, G = steps[0, :rows], steps[1:, :rows].T / (2.0 * _DIFFERENCE)

    # the sine is also small near 180°, where the trace is below 1
    far = float(between[0].trace()) < 1.0
    off = np.inf if far else float(np.abs(missing).max())

    step = pseudo_inverse(G) @ missing
    turned = float(np.abs(step * joint.is_angle).max(initial=0.0))
    scale = min(1.0, _FARTHEST_STEP / max(turned, _SMALLEST_STEP))
    values = values + np.where(joint.is_angle, scale * step, step)

    # If there are fewer coordinates than degrees of freedom, a noisy pose is fitted by least
    # squares. The search then ends when the steps are small.
    in_part = len(values) < len(missing) and off < _FARTHEST_MISFIT
    settled = in_part and float(np.abs(step).max(initial=0.0)) < _SETTLED
    return values, G, off < _CLOSE or settled
