"""Faults of a sensor during a run: stuck output, slip and heading drift.

A fault changes the measured orientations only. A command takes effect with the next block of
samples, at most 0.2 s later.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_simulators.body import Rotation, from_wxyz, to_wxyz

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

SLIP_S = 0.3
"""Duration of a slip, s."""
_SLIP_AXIS = np.array([0.6, -0.5, 0.62]) / np.linalg.norm([0.6, -0.5, 0.62])
"""Axis of a slip in the sensor frame. It is oblique to all sensor axes."""


class SensorFaults:
    """Faults of one sensor."""

    def __init__(self) -> None:
        self._stuck = False
        self._held: Array | None = None
        self._slipped_rad, self._slip_s, self._before_rad = 0.0, -np.inf, 0.0
        self._rate_rad_s, self._turned_rad = 0.0, 0.0
        self._now_s = -np.inf

    def stick(self) -> None:
        """Repeat the next orientation until `free` is called."""
        self._stuck = True

    def free(self) -> None:
        """End the stuck output; slip and heading error remain."""
        self._stuck, self._held = False, None

    def slip(self, angle_rad: float) -> None:
        """Rotate the sensor on the segment by an angle, in addition to earlier slips."""
        self._before_rad = self._slipped_rad
        self._slipped_rad += angle_rad
        self._slip_s = self._now_s

    def drift(self, rate_rad_s: float) -> None:
        """Rotate the sensor's world about the vertical at a constant rate; 0 stops the drift."""
        self._rate_rad_s = rate_rad_s

    def apply(self, t_s: Array, measured: Array) -> Array:
        """Return q_world_sensor with the faults, shape (n, 4); a NaN input yields NaN."""
        if not len(t_s):
            return measured
        before_s = float(t_s[0]) if np.isinf(self._now_s) else self._now_s
        turned = self._turned_rad + self._rate_rad_s * (t_s - before_s)
        self._now_s, self._turned_rad = float(t_s[-1]), float(turned[-1])
        share = np.clip((t_s - self._slip_s) / SLIP_S, 0.0, 1.0)
        slipped = self._before_rad + share * (self._slipped_rad - self._before_rad)

        # A heading drift is multiplied on the world side, and a slip on the sensor side.
        known = np.isfinite(measured[:, 0])
        if (np.any(turned) or np.any(slipped)) and np.any(known):
            world = Rotation.from_rotvec(turned[known, None] * np.array([0.0, 0.0, 1.0]))
            slide = Rotation.from_rotvec(slipped[known, None] * _SLIP_AXIS)
            measured = measured.copy()
            measured[known] = to_wxyz(world * from_wxyz(measured[known]) * slide)

        if self._stuck and self._held is None and np.any(known):
            self._held = measured[known][0].copy()
        if self._held is not None:
            measured = np.where(known[:, None], self._held, measured)
        return measured
