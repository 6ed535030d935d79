"""What a rig.toml means, in SI. Law: frozen; two equal sources may share one running driver."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.calibration import CalibrationSettings
    from jointfit_daemon.config._tables import MqttSettings, RecordingSettings
    from jointfit_daemon.driver import Driver
    from jointfit_daemon.model import Chain

MOCAP = "mocap"
"""Id of the one optical source."""


@dataclass(frozen=True, slots=True)
class Source:
    """One device to be read, with the driver that reads it."""

    id: str
    kind: Literal["imu", "mocap"]
    driver: str
    rate_hz: float
    """Samples per second asked of the device; for mocap the configured output rate, a guess."""
    segment: str | None
    """The segment it is worn on; None for mocap."""
    settings: Any
    """The driver's own validated settings."""
    driver_class: type[Driver]


@dataclass(frozen=True, slots=True)
class Rig:
    """One wearer, one limb, the devices on it and where the results go."""

    name: str
    output_rate_hz: float
    align_mode: Literal["smooth", "fast"]
    chain: Chain
    sources: tuple[Source, ...]
    """IMUs in the order of rig.toml, then mocap if there is one."""
    calibration: CalibrationSettings
    calibration_store: str
    mqtt: MqttSettings
    recording: RecordingSettings | None
    table: Mapping[str, Any]
    """The rig.toml as parsed, for the event log; it never holds a secret (passwords are files)."""
