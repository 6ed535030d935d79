"""Contents of a rig.toml in SI units.

The data are frozen, so that equal sources can share a running driver.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.calibration import CalibrationSettings
    from jointfit_daemon.config._tables import (
        LslSettings,
        MetricsSettings,
        MqttSettings,
        RecordingSettings,
    )
    from jointfit_daemon.driver import Driver
    from jointfit_daemon.files.models import LoadedModel
    from jointfit_daemon.model import Chain

MOCAP = "mocap"
"""Id of the only optical source."""


@dataclass(frozen=True, slots=True)
class Source:
    """One device of the rig, with its driver and settings."""

    id: str
    kind: Literal["imu", "mocap"]
    driver: str
    rate_hz: float
    """Sample rate requested of the device, Hz; for mocap, by default the output rate."""
    segment: str | None
    """Segment to which the sensor is attached; None for mocap."""
    settings: Any
    """Validated settings of the driver."""
    driver_class: type[Driver]


@dataclass(frozen=True, slots=True)
class Rig:
    """One subject, one limb, its devices, and the outputs."""

    name: str
    output_rate_hz: float
    align_mode: Literal["smooth", "fast"]
    chain: Chain
    sources: tuple[Source, ...]
    """IMUs in the order of rig.toml, then mocap, if any."""
    calibration: CalibrationSettings
    calibration_store: str
    mqtt: MqttSettings
    recording: RecordingSettings | None
    metrics: MetricsSettings | None
    lsl: LslSettings | None
    chain_model: LoadedModel | None
    """Chain model for inverse kinematics from the markers; None without one."""
    table: Mapping[str, Any]
    """The parsed rig.toml, for recordings, with the content of the chain model; it contains no
    secrets (passwords are in files)."""

    @property
    def cameras(self) -> tuple[Source, ...]:
        """The motion-capture sources."""
        return tuple(source for source in self.sources if source.kind == "mocap")
