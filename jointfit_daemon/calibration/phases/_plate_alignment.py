"""Align phase, in which a plate with all sensors and with markers is rotated by hand.

The rotation from each sensor world to the optical world is estimated only in this phase, never from
skin-mounted sensors. If the movement does not determine the full rotation, only the heading is
estimated, with a note. If it does not determine the heading either, the phase fails with the
reason.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.calibration._errors import CalibrationError
from jointfit_daemon.calibration._quality import WorldQuality, quality_table
from jointfit_daemon.calibration._trial import PLATE
from jointfit_daemon.calibration.anatomy import body_column, columns, moving_template
from jointfit_daemon.calibration.registration import (
    fit_observable_alignment,
    sensor_at,
    sensor_lags,
)
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion
from jointfit_daemon.limb_model import rigid_fit, visible

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from jointfit_daemon.calibration._trial import (
        CalibrationSettings,
        CalibrationTrial,
        OpticalTrack,
        SensorTrack,
    )
    from jointfit_daemon.model import Quaternion

MIN_FRAMES = 200
"""Smallest number of frames in which the sensor has data and the plate is visible."""
MAX_RMS = np.deg2rad(6.0)
"""Largest robust scale of the residual angles, rad. A larger scale indicates a loose sensor, a
sensor that is not on the plate, or swapped markers.
"""
MAX_FRAMES = 3000
"""Largest number of frames that are used; longer recordings are decimated."""


@dataclass(frozen=True, slots=True)
class AlignedSensor:
    """World of one sensor relative to the optical world."""

    q_optical_world: Quaternion
    quality: WorldQuality


@dataclass(frozen=True, slots=True)
class PlateAlignment:
    """Worlds of all sensors relative to the optical world."""

    sensors: Mapping[str, AlignedSensor]
    notes: tuple[str, ...] = ()

    def world(self, sensor: str) -> Quaternion:
        """Return q_optical_world of a sensor.

        Raises
        ------
        CalibrationError
            The sensor was not on the plate.
        """
        if sensor not in self.sensors:
            raise CalibrationError(
                f"{sensor}: missing in the align phase; repeat it with all sensors on the plate"
            )
        return self.sensors[sensor].q_optical_world

    @property
    def quality(self) -> dict[str, WorldQuality]:
        """Quality figures of every sensor."""
        return {name: item.quality for name, item in self.sensors.items()}

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {
            "sensors": {
                name: {
                    "q_optical_world": list(item.q_optical_world),
                    **quality_table(item.quality),
                }
                for name, item in self.sensors.items()
            },
            "notes": list(self.notes),
        }

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> PlateAlignment:
        """Return the alignment from its JSON form."""
        return PlateAlignment(
            {
                name: AlignedSensor(
                    as_quaternion(item["q_optical_world"]),
                    WorldQuality(*(item[field.name] for field in fields(WorldQuality))),
                )
                for name, item in data["sensors"].items()
            },
            tuple(data["notes"]),
        )


def fit_plate_alignment(
    trial: CalibrationTrial,
    settings: CalibrationSettings,
    *,
    lag_ns: Mapping[str, int] | None = None,
) -> PlateAlignment:
    """Align the world of every sensor in the trial with the optical world.

    Parameters
    ----------
    trial : CalibrationTrial
        Movement of the plate. All sensors of the trial are assumed to be on the plate.
    settings : CalibrationSettings
        `plate` names the rigid body, or ``markers["plate"]`` the markers.
    lag_ns : mapping, optional
        Known lags (sensor minus optical time stamp), ns. Other lags are estimated; if the estimate
        is rejected, 0 is used.

    Raises
    ------
    CalibrationError
        The plate is missing or hardly visible, or the movement or the fit of a sensor is
        insufficient. The error contains all reasons.
    """
    if trial.optical is None or not trial.sensors:
        raise CalibrationError("align: needs data of the optical system and of at least one sensor")

    t_ns, q_plate = plate_track(trial.optical, settings)
    unknown = {n: track for n, track in trial.sensors.items() if n not in (lag_ns or {})}
    turning = sensor_lags(t_ns, q_plate, unknown)
    accepted = {n: round(lag.lag_ns) for n, lag in turning.items() if lag.refused is None}
    lags = accepted | dict(lag_ns or {})

    reasons: list[str] = []
    found: dict[str, AlignedSensor] = {}
    for name, track in trial.sensors.items():
        try:
            sigma_ns = turning[name].sigma_ns if name in turning and name in lags else None
            found[name] = _align_one(name, track, (t_ns, q_plate), lags.get(name), sigma_ns)
        except CalibrationError as refusal:
            reasons += refusal.reasons
    if reasons:
        raise CalibrationError(*reasons)

    notes = [
        f"{name}: only the heading was aligned; rotate the plate about more axes"
        for name, item in found.items()
        if item.quality.kind == "heading"
    ]
    return PlateAlignment(found, tuple(notes))


def plate_track(
    optical: OpticalTrack, settings: CalibrationSettings
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return time stamps, ns, shape (n,), and q_optical_plate, shape (n, 4).

    q_optical_plate is NaN in frames in which the plate is not visible.

    Raises
    ------
    CalibrationError
        rig.toml contains no plate, or the plate is missing in the stream or hardly visible.
    """
    if settings.plate is not None:
        column = body_column(optical, "plate", settings.plate)
        q = rotation.normalize(optical.body_orientations[:, column])
    elif PLATE in settings.markers:
        positions = optical.positions[:, columns(optical, PLATE, settings)]
        q = rigid_fit(moving_template(positions), positions)[0]
    else:
        raise CalibrationError(
            "align: no plate configured; name its rigid body (plate = …) or its markers"
            " (markers.plate = […])"
        )

    if (seen := int(np.count_nonzero(visible(q)))) < MIN_FRAMES:
        raise CalibrationError(
            f"plate: visible in {seen} frames, at least {MIN_FRAMES} are needed; hold it in view"
        )
    return optical.t_ns, q


def _align_one(
    name: str,
    track: SensorTrack,
    plate: tuple[NDArray[np.int64], NDArray[np.float64]],
    lag_ns: int | None,
    lag_sigma_ns: float | None,
) -> AlignedSensor:
    t_ns, q_plate = plate
    q_sensor = sensor_at(track, t_ns, lag_ns or 0)
    both = np.flatnonzero(visible(q_sensor) & visible(q_plate))
    if both.size < MIN_FRAMES:
        raise CalibrationError(
            f"{name}: in {both.size} frames the sensor has data and the plate is visible, at least"
            f" {MIN_FRAMES} are needed; check that the sensor streams and the plate is in view"
        )

    every = both[:: -(-both.size // MAX_FRAMES)]
    fit = fit_observable_alignment(q_sensor[every], q_plate[every])
    if fit.kind == "mount":
        raise CalibrationError(f"{name}: {'; '.join(fit.refused)}")
    if fit.residual_scale > MAX_RMS:
        raise CalibrationError(
            f"{name}: moves {np.rad2deg(fit.residual_scale):.1f} deg relative to the plate; fix the"
            " sensor to the plate and check that all plate markers belong to it"
        )
    quality = WorldQuality(
        fit.kind, fit.kappa, fit.weak_error, fit.residual_rms, lag_ns, lag_sigma_ns
    )
    return AlignedSensor(as_quaternion(fit.q_world), quality)
