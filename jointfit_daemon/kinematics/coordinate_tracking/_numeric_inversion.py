r"""Coordinates of joints without a closed form, by Gauss-Newton steps with numerical derivatives.

Where a joint has fewer coordinates than degrees of freedom, the sine of the rotation that they
leave is minimized instead of the rotation.

Invariant: an instant takes at most `STEPS_PER_JOINT` steps per joint and `SPARE_STEPS` in total. An
inversion that needs more continues in the next instant, and its joint is unknown until it ends.
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
"""Steps of a joint that follows its coordinates from instant to instant."""
SPARE_STEPS = 6
"""Steps for joints that move fast, or whose coordinates are searched."""
_DIFFERENCE = 1e-5
"""Half the interval of a central difference, rad and m; its error is about 1e-10."""
_RIDGE = 1e-12
"""Added to G^T G, so that a gimbal lock yields finite angles."""
_MOST_ITERATIONS = 8
"""Iterations from one start; two are typical from the instant before."""
_FARTHEST_STEP = 0.8
"""Largest step of an angle, rad: most inversions begin close to the solution."""
_CLOSE = 1e-3
"""Distance, rad and m, from which one more step leads to the solution: the remaining error is about
its square."""
_SETTLED = 1e-4
"""Largest step, rad and m, of a joint that its coordinates describe in part only."""
_FARTHEST_MISFIT = 0.5
"""Largest rotation that its coordinates may leave undescribed, rad; more is another solution."""
_SMALLEST_STEP = 1e-10
_QUARTERS = (0.0, 0.5 * np.pi, -0.5 * np.pi, np.pi)
"""Angles from which an inversion begins without an instant before, rad."""
_STEEP = 0.87
"""Angle of the second of three rotations from which an inversion begins: 50 degrees."""
_MOST_ANGLES = 3


class NumericInversion:
    """Inverts the poses of some joints, instant by instant.

    Parameters
    ----------
    joints
        Coordinates by number of the segment.
    """

    def __init__(self, joints: Mapping[int, JointCoordinates]) -> None:
        self._joints = dict(joints)
        self._starts = {i: _starts(joint) for i, joint in self._joints.items()}
        """Values to begin from, and their rotations."""
        self._open: dict[int, Array] = {}
        """Values of inversions that have not ended."""
        self._iterations = dict.fromkeys(self._joints, 0)
        """Iterations from the present start."""
        self._attempts = dict.fromkeys(self._joints, 0)
        """Starts that did not lead to the pose, since the last success."""
        self._turn = 0

    def invert(
        self, poses: Mapping[int, tuple[Array, Array]], last: Mapping[int, Array]
    ) -> dict[int, tuple[Array, Array]]:
        """Return values, shape (k,), and their derivative, (3 or 6, k), of joints that have them.

        Parameters
        ----------
        poses
            Rotation, shape (3, 3), and origin of a free segment, m, (3,) or (0,), of each joint.
        last
            Values at the instant before, of joints that had some.
        """
        # Known joints come first. The others take turns with the rest of the steps.
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
        """Take one step, and return values and derivative if it leads to the pose."""
        joint = self._joints[i]
        values = self._open.get(i)
        if values is None:
            values = last if last is not None and not self._attempts[i] else self._start(i, A)

        self._iterations[i] += 1
        values, G, is_found = _stepped(joint, values, A, origin)
        if is_found:
            # within half a turn, and the second of three rotations within a quarter
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
        """Return the values whose rotation is nearest to A, the next one after every failure."""
        values, rotations = self._starts[i]
        nearest = np.argsort(-(rotations @ A.ravel()), kind="stable")
        return np.asarray(values[nearest[max(self._attempts[i] - 1, 0) % len(values)]])


def spread(G: Array) -> Array:
    """Return the pseudo-inverse of a derivative, which maps a step to coordinates."""
    square = G.T @ G + _RIDGE * np.eye(G.shape[-1])
    return np.asarray(np.linalg.solve(square, G.T))


def _starts(joint: JointCoordinates) -> tuple[Array, Array]:
    """Return values from which an inversion can begin, and their rotations, shape (n, 9)."""
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


def _stepped(
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

    # sin(x) instead of x: exact for the small rotations at the end
    steps = np.zeros((1 + count, 6))
    steps[:, :3] = 0.5 * (between[:, (2, 0, 1), (1, 2, 0)] - between[:, (1, 2, 0), (2, 0, 1)])
    if len(origin):
        steps[:, 3:] = np.concatenate((origin[None], t[1 + count :])) - t[: 1 + count]
    missing, G = steps[0, :rows], steps[1:, :rows].T / (2.0 * _DIFFERENCE)

    # the sine is also small near half a turn, where the trace is below 1
    far = float(between[0].trace()) < 1.0
    off = np.inf if far else float(np.abs(missing).max())

    step = spread(G) @ missing
    turned = float(np.abs(step * joint.is_angle).max(initial=0.0))
    scale = min(1.0, _FARTHEST_STEP / max(turned, _SMALLEST_STEP))
    values = values + np.where(joint.is_angle, scale * step, step)

    # Fewer coordinates than degrees of freedom describe a noisy pose by least squares.
    in_part = len(values) < len(missing) and off < _FARTHEST_MISFIT
    settled = in_part and float(np.abs(step).max(initial=0.0)) < _SETTLED
    return values, G, off < _CLOSE or settled
