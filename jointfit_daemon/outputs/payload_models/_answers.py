"""Models of the ``data`` of answers, by request."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from jointfit_daemon.outputs.payload_models._streams import Number, Table, Time
from jointfit_daemon.pipeline.events import CalibrationPhase  # noqa: TC001 - pydantic reads it


class PhaseAnswer(Table):
    """Answer to ``calibrate`` and ``static``."""

    phase: CalibrationPhase


class MarkAnswer(Table):
    """Answer to ``mark``."""

    number: int = Field(description="number of the mark since the start of the daemon")
    t_us: Time | None
    text: str


class ReloadAnswer(Table):
    """Answer to ``reload``."""

    rig: str
    devices: list[str]


class RestartDeviceAnswer(Table):
    """Answer to ``restart-device``."""

    device: str


class RateAnswer(Table):
    """Answer to ``rate``."""

    before_hz: float
    output_rate_hz: float


class OnlineRefit(Table):
    """Last refit by online learning: RMS errors against the cameras on the newest frames."""

    rounds: int = Field(description="number of accepted refits since the functional phase")
    from_version: int | None
    before_deg: dict[str, Number] = Field(description="errors before, by segment and joint")
    after_deg: dict[str, Number] = Field(description="errors after, by segment and joint")


class StoredVersion(Table):
    """One stored calibration."""

    version: int
    created_utc: str | None
    software: str | None
    method: str | None
    procedure: str | None
    restored_from: int | None
    online: OnlineRefit | None
    functional: bool | None
    usable: bool
    segments_deg: dict[str, Number]
    flexion_deg: dict[str, Number]
    fault: str | None


class CalibrationsAnswer(Table):
    """Answer to ``calibrations``."""

    store: str
    in_force: int | None
    versions: list[StoredVersion]
    omitted: int


class UseCalibrationAnswer(Table):
    """Answer to ``use-calibration``."""

    version: int
    phase: CalibrationPhase


class CheckLine(Table):
    """Result of one check."""

    check: str
    id: str
    level: Literal["ok", "warning", "error"]
    text: str
    remedy: str


class SelftestAnswer(Table):
    """Answer to ``selftest``."""

    level: Literal["ok", "warning", "error"]
    checks: list[CheckLine]


class RecordAnswer(Table):
    """Answer to ``record``."""

    directory: str
    file: str = Field(
        description="name of the open file, or of the last file if none is open; may be empty"
    )
    duration_s: float = Field(description="from the start of the recording to now, or to its end")
    written_bytes: int
    lost: int = Field(description="messages lost because they were not written")
    failure: str | None = Field(description="why the recording is interrupted")
    free_bytes: int | None = Field(description="free space for recordings")
    active: bool


class PhysicalTestOutcome(Table):
    """Outcome of a complete test."""

    id: str
    agrees: bool = Field(description="whether world, axes and direction are as configured")
    deviations_deg: list[float] = Field(
        description="angle of each measured rotation from the requested one"
    )
    found: str = Field(description="convention of the quaternions as received, in words")
    rig_toml: list[str] = Field(description="lines of the sensor's [[imu]] table that correct it")
    alternatives: list[str] = Field(description="equally good lines, with another heading")
    lines: list[str] = Field(description="the outcome in words")


class PhysicalTestAnswer(Table):
    """Answer to ``physical-test``."""

    device: str
    state: Literal["opening", "turning", "finished", "failed", "stopped"]
    step: int = Field(description="number of steps that are done")
    steps: list[str] = Field(description="instructions")
    rotations: list[str] = Field(description="names of the measured rotations")
    text: str | None = Field(description="why the test failed")
    result: PhysicalTestOutcome | None


ANSWERS: dict[str, type[Table]] = {
    "calibrate": PhaseAnswer,
    "static": PhaseAnswer,
    "mark": MarkAnswer,
    "reload": ReloadAnswer,
    "restart-device": RestartDeviceAnswer,
    "rate": RateAnswer,
    "calibrations": CalibrationsAnswer,
    "use-calibration": UseCalibrationAnswer,
    "selftest": SelftestAnswer,
    "record": RecordAnswer,
    "physical-test": PhysicalTestAnswer,
}
"""Model of the ``data`` of an answer that is not an error, by request."""
