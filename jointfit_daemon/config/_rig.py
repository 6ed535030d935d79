"""Contents of a rig.toml in SI units.

All data are frozen and comparable, so that equal sources can share a running driver.
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
    """Sample rate that is requested from the device, Hz. For mocap the default is the output
    rate."""
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
    """IMUs in the order of rig.toml, followed by the motion-capture source if there is one."""
    calibration: CalibrationSettings
    calibration_store: str
    mqtt: MqttSettings
    recording: RecordingSettings | None
    metrics: MetricsSettings | None
    lsl: LslSettings | None
    chain_model: LoadedModel | None
    """Chain model for inverse kinematics from the markers; None if none is configured."""
    table: Mapping[str, Any]
    """The parsed rig.toml with the content of the chain model, for recordings. It contains no
    secrets, because passwords are stored in separate files."""

    @property
    def cameras(self) -> tuple[Source, ...]:
        """The motion-capture sources."""
        return tuple(source for source in self.sources if source.kind == "mocap")
