"""Model of the orientation error of an IMU: world frame, slow drift and white noise.

The *base world* is the world in which the movement of the subject is described, with z up.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_simulators.body import Rotation, from_wxyz, heading, random_vector_signal, to_wxyz

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_simulators.settings import Knobs

_DRIFT_HZ = (0.005, 0.1)
"""Frequency band of the slow error, Hz. Its periods of ten seconds to minutes are typical of fusion
filters."""


class OrientationSensor:
    r"""Orientation output of one IMU.

    .. math:: \hat q(t) = e(t)\; q_{W_s W}\; q(t)\; n(t)

    Here *q* is the true orientation in the base world *W*. :math:`W_s` is the sensor's own world,
    which differs from the base world by a heading, and with a simulated fault also by an
    inclination. The slow error *e* is a rotation in world axes, as in fusion filters. The white
    noise *n* is a rotation in sensor axes.

    Parameters
    ----------
    knobs
        Settings with the magnitudes of the errors.
    name
        Sensor id, which selects the random streams.
    """

    def __init__(self, knobs: Knobs, name: str) -> None:
        world = knobs.random(f"world {name}")
        self.heading_rad = float(world.uniform(0.0, np.radians(knobs.heading_spread_deg)))
        about = world.uniform(0.0, 2 * np.pi)
        tilted = knobs.world_tilt_sensor in {"", name}
        tilt = np.radians(knobs.world_tilt_deg) if tilted else 0.0
        level = Rotation.from_rotvec([tilt * np.cos(about), tilt * np.sin(about), 0.0])
        self.world = level * heading(self.heading_rad)
        """Rotation from the base world to the sensor's own world."""

        self._slow = random_vector_signal(
            knobs.random(f"slow error {name}"),
            1,
            low_hz=_DRIFT_HZ[0],
            high_hz=_DRIFT_HZ[1],
            rms=np.radians(knobs.orientation_slow_deg),
        )
        self._white = knobs.random(f"white error {name}")
        self._white_rad = np.radians(knobs.orientation_white_deg) / np.sqrt(3)

    def report(self, t_s: Array, q_base_sensor: Array) -> Array:
        """Return the measured q_world_sensor, shape (n, 4); a NaN input yields NaN."""
        known = np.isfinite(q_base_sensor[:, 0])
        measured = np.full_like(q_base_sensor, np.nan)
        noise = self._white.standard_normal((len(t_s), 3)) * self._white_rad
        if np.any(known):
            true = from_wxyz(q_base_sensor[known])
            slow = Rotation.from_rotvec(self._slow.at(t_s[known]))
            measured[known] = to_wxyz(slow * self.world * true * Rotation.from_rotvec(noise[known]))
        return measured
