"""Rates of joint angles, computed as difference quotients over the last 50 ms.

A shorter span would increase the noise of a rate. A rate applies to the middle of its span, which
is 25 ms before the frame at a span of 50 ms.

Invariant: the cost per frame is O(1), and only frames with known angles are compared.
"""

from __future__ import annotations

from collections import deque
from math import pi

from jointfit_daemon.model import JointAngles

SPAN_NS = 50_000_000
"""Shortest span of a difference quotient if enough frames exist, ns."""
MAX_GAP_NS = 120_000_000
"""Longest span of a difference quotient, ns."""


class AngleRates:
    """Computes the rates of the joints of one limb."""

    def __init__(self) -> None:
        self._past: dict[str, deque[tuple[int, JointAngles]]] = {}

    def update(
        self, t_ns: int, joint: str, angles: JointAngles | None, *, gimbal: bool
    ) -> JointAngles | None:
        """Add the angles of one joint and return their rates, rad/s, or None if unknown.

        Parameters
        ----------
        t_ns : int
            Instant of the frame; increases from call to call.
        joint : str
            Name of the joint.
        angles : JointAngles or None
            Angles in this frame, rad; None if unknown.
        gimbal : bool
            Whether the joint is at gimbal lock. The rates are then unknown. Later rates use only
            frames after the gimbal lock.
        """
        past = self._past.get(joint)
        if past is None:
            past = self._past[joint] = deque()
        if angles is None or gimbal:
            past.clear()
            return None

        while past and (t_ns - past[0][0] > MAX_GAP_NS or past[0][0] >= t_ns):
            past.popleft()
        while len(past) > 1 and t_ns - past[1][0] >= SPAN_NS:
            past.popleft()
        past.append((t_ns, angles))

        start_ns, start = past[0]
        if start_ns == t_ns:
            return None
        per_s = 1e9 / (t_ns - start_ns)
        return JointAngles(
            _wrap(angles.flexion - start.flexion) * per_s,
            _wrap(angles.adduction - start.adduction) * per_s,
            _wrap(angles.rotation - start.rotation) * per_s,
        )


def _wrap(angle: float) -> float:
    if -pi < angle < pi:
        return angle
    return angle - 2.0 * pi * round(angle / (2.0 * pi))
