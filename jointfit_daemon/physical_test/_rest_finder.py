"""Detection of the poses at rest in a stream of orientations. No clock is read."""

from __future__ import annotations

from collections import deque
from math import radians
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.units import NS_PER_S

if TYPE_CHECKING:
    from jointfit_daemon.model import Quaternion

REST_S = 1.0
"""Shortest duration of a rest, s."""
STILL_RAD = radians(1.5)
"""Largest deviation from the mean orientation during a rest, rad. After a movement the orientation
filter of a device settles more slowly than the hand.
"""
MOVED_RAD = radians(45.0)
"""Smallest rotation between two rests, rad, so that a pause during the movement is not a rest."""
_FEWEST = 5
"""Smallest number of samples in a rest."""


class RestFinder:
    """Detects when the sensor is at rest in an orientation far from the previous rest."""

    def __init__(self) -> None:
        self._recent: deque[tuple[int, Quaternion]] = deque()
        self._last: Quaternion | None = None

    def add(self, t_ns: int, q_world_sensor: Quaternion) -> tuple[int, int] | None:
        """Add a sample; return begin and end of a new rest, ns, or None.

        Parameters
        ----------
        t_ns
            Time of the sample, ns; must increase from call to call.
        q_world_sensor
            Unit quaternion in any fixed convention, because only angles between samples are used.
        """
        recent = self._recent
        recent.append((t_ns, q_world_sensor))
        while len(recent) > 1 and t_ns - recent[1][0] >= REST_S * NS_PER_S:
            recent.popleft()
        begin_ns = recent[0][0]
        if t_ns - begin_ns < REST_S * NS_PER_S or len(recent) < _FEWEST:
            return None

        samples = np.array([q for _, q in recent])
        mean = rotation.average(samples)
        if rotation.angle_between(mean, samples).max() > STILL_RAD:
            return None
        if self._last is not None and rotation.angle_between(self._last, mean) < MOVED_RAD:
            return None

        w, x, y, z = mean.tolist()
        self._last = (w, x, y, z)
        recent.clear()
        return begin_ns, t_ns
