"""Detection of rest from live orientations.

The detector uses the timestamps of the samples. It uses only relative rotations, so an arbitrary
heading has no effect.
"""

from __future__ import annotations

from collections import deque
from math import radians
from typing import TYPE_CHECKING

from jointfit_daemon.kinematics.rotation_scalar import angle_between_one, normalize_one

if TYPE_CHECKING:
    from jointfit_daemon.model import Quaternion

WINDOW_NS = 1_000_000_000
"""Length of the window that must be at rest, ns."""
STEP_NS = 50_000_000
"""Averaging interval of the orientations, ns."""
LONGEST_PAUSE_NS = WINDOW_NS // 4
"""Longest pause in the data within a window, ns."""
MAX_ROTATION = radians(1.0)
"""Largest rotation from the first step of a window to any later step, rad. The limit is three times
the noise of a sensor on a table.
"""


class StillnessMonitor:
    """Detects from live samples whether one sensor was at rest for a complete window.

    A window is at rest if the rotation from its first step to every later step is below the limit.
    A step is the mean of its samples, so that white noise of a third of a degree is not a movement.
    The window ends with the last complete step, so a movement is detected at most one step late. A
    pause in the data or a decreasing timestamp starts a new window.
    """

    def __init__(self) -> None:
        self._steps: deque[tuple[int, Quaternion]] = deque()
        """End and mean orientation of the last steps, at most `WINDOW_NS` / `STEP_NS` + 2."""
        self._began_ns = self._last_ns = 0
        self._sum: Quaternion | None = None
        self._calm = False

    def feed(self, t_ns: int, q: Quaternion) -> bool:
        """Process one orientation at `t_ns`; return True while the last window was at rest."""
        pause = t_ns - self._last_ns
        self._last_ns = t_ns
        if self._sum is None or not 0 <= pause <= LONGEST_PAUSE_NS:
            self._steps.clear()
            self._began_ns, self._sum, self._calm = t_ns, q, False
        elif t_ns - self._began_ns >= STEP_NS:
            self._steps.append((t_ns, normalize_one(self._sum)))
            self._began_ns, self._sum = t_ns, q
            self._calm = self._is_at_rest(t_ns)
        else:
            # The quaternions of a step are summed with equal signs.
            w, x, y, z = self._sum
            sign = -1.0 if w * q[0] + x * q[1] + y * q[2] + z * q[3] < 0.0 else 1.0
            self._sum = (w + sign * q[0], x + sign * q[1], y + sign * q[2], z + sign * q[3])
        return self._calm

    def _is_at_rest(self, t_ns: int) -> bool:
        steps = self._steps
        while len(steps) > 1 and t_ns - steps[1][0] >= WINDOW_NS:
            steps.popleft()
        began, start = steps[0]
        # With irregular time stamps, the steps span up to `STEP_NS` less than the window.
        if t_ns - began < WINDOW_NS - STEP_NS:
            return False
        return all(angle_between_one(start, q) < MAX_ROTATION for _, q in steps)
