"""How fast joint angles change. Law: pure, O(1) a frame; only frames that are there are compared.

A difference over the last twentieth of a second: what single samples scatter is divided by that
time and no less, and the rate is that of 25 ms ago.
"""

from __future__ import annotations

from collections import deque
from math import pi

from jointfit_daemon.model import JointAngles

SPAN_NS = 50_000_000
LONGEST_NS = 120_000_000
"""Frames further apart than this tell no rate."""


class AngleRates:
    """Follows the angles of the joints of one limb."""

    def __init__(self) -> None:
        self._past: dict[str, deque[tuple[int, JointAngles]]] = {}

    def rates(
        self, t_ns: int, joint: str, angles: JointAngles | None, *, gimbal: bool
    ) -> JointAngles | None:
        """Return the rates of a joint's angles, rad/s; None while they are not known.

        Parameters
        ----------
        t_ns : int
            Instant of the frame; grows from call to call.
        joint : str
            Which one.
        angles : JointAngles or None
            In this frame; None: not known.
        gimbal : bool
            Whether flexion and rotation cannot be told apart: then there is no rate, nor for the
            next frames.
        """
        past = self._past.get(joint)
        if past is None:
            past = self._past[joint] = deque()
        if angles is None or gimbal:
            past.clear()
            return None
        while past and (t_ns - past[0][0] > LONGEST_NS or past[0][0] >= t_ns):
            past.popleft()
        while len(past) > 1 and t_ns - past[1][0] >= SPAN_NS:
            past.popleft()
        past.append((t_ns, angles))
        began_ns, then = past[0]
        if began_ns == t_ns:
            return None
        per_s = 1e9 / (t_ns - began_ns)
        return JointAngles(
            _wrapped(angles.flexion - then.flexion) * per_s,
            (angles.adduction - then.adduction) * per_s,
            _wrapped(angles.rotation - then.rotation) * per_s,
        )


def _wrapped(angle: float) -> float:
    if -pi < angle < pi:
        return angle
    return angle - 2.0 * pi * round(angle / (2.0 * pi))
