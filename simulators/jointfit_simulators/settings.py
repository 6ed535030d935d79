"""Every imperfection of the virtual hardware: one knob each, with its default and its meaning.

Law: this is an edge, so degrees and millimetres are allowed here and nowhere below. Every random
choice of a run follows from `seed` and the name of what it is for, so that turning one knob
leaves all other dice as they fell.
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
    """What is wrong with the sensors, the skin, the clocks and the wires, and how much."""

    seed: int = 1
    rate_hz: float = 100.0
    """Samples per second written into rig.toml; a device obeys its host's handshake."""
    mocap_hz: float = 120.0
    transition_s: float = 1.5
    """Blend between two motions."""

    orientation_slow_deg: float = 1.0
    """RMS length of the sensors' slow orientation error (filter drift), world side."""
    orientation_white_deg: float = 0.3
    """RMS length of the rotation by which single samples scatter, sensor side."""
    soft_tissue_common_deg: float = 5.0
    """RMS rotation of all sensors of a segment against the bone, over walking and squats."""
    soft_tissue_sensor_deg: float = 3.0
    """The same, of each sensor for itself."""
    soft_tissue_random_share: float = 0.15
    """Share of the skin's variance that does not repeat with posture.

    Skin over a limb slides and bulges with what lies under it, and that follows the adjacent
    joints: models linear in the two joints' angles reproduce most of the artefact of one person
    doing one thing (Bonci et al., J. Biomech. 47, 2014). What is left is muscle tension, impact
    wobble and creep, which differ from step to step; 15 % stands for them.
    """
    soft_tissue_knee_share: float = 0.65
    """Share of the repeatable variance that follows the knee; hip or ankle drive the rest."""
    mount_deg: float = 20.0
    """Sensors are strapped on up to this far from the segment's axes, about a random axis."""
    heading_spread_deg: float = 90.0
    """The sensors' worlds point up to this far apart."""
    optical_heading_deg: float = 180.0
    """The wearer faces up to this far to either side of the optical world's own heading."""
    world_tilt_deg: float = 0.0
    """Radical fault: the vertical of a sensor's world is off by this much."""
    world_tilt_sensor: str = ""
    """The sensor with that fault; empty: all."""

    clock_offset_s: float = 3000.0
    """Devices were powered up to this long before the run."""
    clock_skew_ppm: float = 50.0
    """Device clocks run up to this much fast or slow."""
    clock_jitter_us: float = 20.0
    """Standard deviation of a device stamp about its clock."""
    latency_uart_ms: float = 2.0
    latency_can_ms: float = 1.0
    latency_mocap_ms: float = 6.0
    """Least delay from the sampled instant to the wire, by transport."""
    latency_jitter_ms: float = 0.5
    """Mean of the exponential delay on top."""
    dropout: float = 0.005
    """Share of samples that are taken but never sent."""

    occlusion: float = 0.05
    """Share of the time that a marker is hidden."""
    occlusion_burst_s: float = 0.2
    """Mean length of one hiding."""
    marker_soft_tissue_mm: float = 5.0
    """RMS length by which each marker moves against its bone, over walking and squats."""
    marker_common_share: float = 0.5
    """Share of that variance that all markers of a cluster have in common."""
    marker_noise_mm: float = 0.2
    """RMS length of the cameras' scatter."""

    line_flip_per_byte: float = 0.0
    """Probability that one bit of a byte on a serial line is flipped."""
    line_burst_per_byte: float = 0.0
    """Probability that a byte begins a burst of garbage."""
    line_burst_bytes: int = 16
    """Longest burst."""

    def random(self, purpose: str) -> np.random.Generator:
        """Return the dice for one purpose; the same seed and purpose give the same throws."""
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
    """Return `knobs` with every imperfection turned off."""
    nothing: dict[str, Any] = dict.fromkeys(_IMPERFECT, 0.0)
    return dataclasses.replace(knobs, **nothing)


def turn(knobs: Knobs, settings: Iterable[str]) -> Knobs:
    """Return `knobs` with ``NAME=VALUE`` settings applied.

    Raises
    ------
    ValueError
        No such knob, or no such value; the message gives the nearest name.
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
    """Return the knobs of a TOML file of ``name = value`` lines; the rest keep their defaults."""
    table = read_toml(path)
    return turn(Knobs(), [f"{name}={value}" for name, value in table.items()])
