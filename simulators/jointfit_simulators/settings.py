"""Settings of the simulator: the error sources of the virtual hardware, with their defaults.

Angles are in degrees and lengths are in millimetres, because users edit these values. All other
simulator modules use radians and metres.

Invariant: the seed of each random stream depends on `Knobs.seed` and the name of its purpose. A
change of one setting therefore does not affect the random numbers for other purposes.
"""

from __future__ import annotations

import dataclasses
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.files.text import read_toml
from jointfit_daemon.nearest_name import unknown_name

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path


@dataclass(frozen=True, slots=True)
class Knobs:
    """Magnitudes of the sensor, soft-tissue, clock and transport errors.

    RMS rotations are the root mean square of the rotation-vector length.
    """

    seed: int = 1
    rate_hz: float = 100.0
    """IMU sample rate in rig.toml, Hz. The driver may configure another rate."""
    mocap_hz: float = 120.0
    transition_s: float = 1.5
    """Duration of the blend between two motions."""

    orientation_slow_deg: float = 1.0
    """RMS of the slow orientation error (filter drift), applied in the sensor's world frame."""
    orientation_white_deg: float = 0.3
    """RMS of the white orientation noise, applied in the sensor frame."""
    soft_tissue_common_deg: float = 5.0
    """RMS soft-tissue rotation common to all sensors of a segment, over walking and squats."""
    soft_tissue_sensor_deg: float = 3.0
    """RMS soft-tissue rotation of each single sensor, over walking and squats."""
    soft_tissue_random_share: float = 0.15
    """Share of the soft-tissue variance that does not repeat with posture.

    Models that are linear in the two adjacent joint angles reproduce most of the artefact of one
    subject and one task (Bonci et al., J. Biomech. 47, 2014). The remainder, assumed to be 15 %,
    represents muscle tension, impact oscillation and creep, which differ from step to step.
    """
    soft_tissue_knee_share: float = 0.65
    """Share of the repeatable variance that the knee causes. The hip or the ankle causes the
    remainder."""
    mount_deg: float = 20.0
    """Largest sensor-to-segment misalignment, about a random axis."""
    heading_spread_deg: float = 90.0
    """Largest heading difference between the sensors' world frames."""
    optical_heading_deg: float = 180.0
    """Largest magnitude of the heading of the subject in the optical world."""
    world_tilt_deg: float = 0.0
    """Fault: inclination error of a sensor's world frame."""
    world_tilt_sensor: str = ""
    """Sensor with the inclination fault; an empty text selects all sensors."""

    clock_offset_s: float = 3000.0
    """Longest uptime of a device at the start of the run."""
    clock_skew_ppm: float = 50.0
    """Largest clock skew, positive or negative."""
    clock_jitter_us: float = 20.0
    """Standard deviation of the time-stamp jitter."""
    latency_uart_ms: float = 2.0
    latency_can_ms: float = 1.0
    latency_mocap_ms: float = 6.0
    """Minimum delay of the cameras from sampling to transmission. `latency_uart_ms` and
    `latency_can_ms` are the corresponding delays of IMUs."""
    latency_jitter_ms: float = 0.5
    """Mean of the exponentially distributed delay in addition to the minimum."""
    dropout: float = 0.005
    """Share of samples that are taken but not sent."""

    occlusion: float = 0.05
    """Share of time for which a marker is occluded."""
    occlusion_burst_s: float = 0.2
    """Mean duration of an occlusion."""
    marker_soft_tissue_mm: float = 5.0
    """RMS soft-tissue displacement of a marker relative to bone, over walking and squats."""
    marker_common_share: float = 0.5
    """Share of the marker displacement variance that is common to all markers of a cluster."""
    marker_noise_mm: float = 0.2
    """RMS length of the marker position noise."""

    line_flip_per_byte: float = 0.0
    """Probability of a flipped bit per byte on a serial line."""
    line_burst_per_byte: float = 0.0
    """Probability per byte that a burst of random bytes starts."""
    line_burst_bytes: int = 16
    """Maximum length of a burst, bytes."""

    def random(self, purpose: str) -> np.random.Generator:
        """Return the random generator for a purpose, which depends on `seed` and `purpose` only."""
        return np.random.default_rng([self.seed, zlib.crc32(purpose.encode())])


_IMPERFECT = (
    "orientation_slow_deg",
    "orientation_white_deg",
    "soft_tissue_common_deg",
    "soft_tissue_sensor_deg",
    "mount_deg",
    "heading_spread_deg",
    "optical_heading_deg",
    "world_tilt_deg",
    "clock_skew_ppm",
    "clock_jitter_us",
    "latency_jitter_ms",
    "dropout",
    "occlusion",
    "marker_soft_tissue_mm",
    "marker_noise_mm",
    "line_flip_per_byte",
    "line_burst_per_byte",
)


def perfect(knobs: Knobs) -> Knobs:
    """Return `knobs` with all errors zero, except clock offsets and minimum latencies."""
    nothing: dict[str, Any] = dict.fromkeys(_IMPERFECT, 0.0)
    return dataclasses.replace(knobs, **nothing)


def apply_settings(knobs: Knobs, settings: Iterable[str]) -> Knobs:
    """Return `knobs` with the changes in ``NAME=VALUE`` settings.

    Raises
    ------
    ValueError
        The setting does not exist or its value has the wrong type. The message suggests the
        nearest name.
    """
    kinds = {field.name: type(getattr(knobs, field.name)) for field in dataclasses.fields(Knobs)}

    changed: dict[str, Any] = {}
    for setting in settings:
        name, _, value = setting.partition("=")
        if name not in kinds:
            raise ValueError(unknown_name("knob", name, kinds))
        try:
            changed[name] = kinds[name](value)
        except ValueError as error:
            raise ValueError(f"{setting!r}: expected {kinds[name].__name__}") from error
    return dataclasses.replace(knobs, **changed)


def knobs_from_toml(path: Path) -> Knobs:
    """Return the settings in a TOML file with ``name = value`` lines; the rest have defaults."""
    table = read_toml(path)
    return apply_settings(Knobs(), [f"{name}={value}" for name, value in table.items()])
