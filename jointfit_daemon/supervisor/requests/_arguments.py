"""The requests that the daemon accepts, with name, arguments and effect.

Invariant: `REQUESTS` corresponds to the table of requests in docs/mqtt.md.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, model_validator

LONGEST_MARK = 200
"""Longest text of a mark, characters."""
LEAST_RATE_HZ, GREATEST_RATE_HZ = 1.0, 1000.0
"""Limits of a requested output rate, Hz."""
MOST_VERSIONS = 50
"""Largest number of stored calibrations in one answer. Each takes about 500 bytes."""
LAST_VERSION = 999_999_999
"""Largest version number in a calibration store."""


class RequestArguments(BaseModel):
    """Base of every request: unknown keys are refused, and types are not converted."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    transaction: str = Field("", max_length=256, description="text that the answer repeats")


class CalibrateArguments(RequestArguments):
    """``bridge/request/calibrate``."""

    phase: Literal["align", "static", "functional", "abort", "revert"] = Field(
        description="phase to start, or `abort`; `revert` reverts online learning"
    )
    seconds: float | None = Field(
        None, gt=0, le=600, description="duration of the phase, s; default: as in rig.toml"
    )
    force: bool = Field(
        False, description="store the result even if it is worse than the calibration in force"
    )


class StaticArguments(RequestArguments):
    """``bridge/request/static``."""

    seconds: float | None = Field(
        None, gt=0, le=600, description="duration of the static pose, s; default: as in rig.toml"
    )


class MarkArguments(RequestArguments):
    """``bridge/request/mark``."""

    text: str = Field(
        min_length=1,
        max_length=LONGEST_MARK,
        description=f"label of this instant, 1 to {LONGEST_MARK} characters",
    )


class ReloadArguments(RequestArguments):
    """``bridge/request/reload``."""


class RestartDeviceArguments(RequestArguments):
    """``bridge/request/restart-device``."""

    device: str = Field(
        min_length=1, max_length=256, description="id of a device in rig.toml, or mocap"
    )


class RateArguments(RequestArguments):
    """``bridge/request/rate``."""

    hz: float = Field(
        ge=LEAST_RATE_HZ,
        le=GREATEST_RATE_HZ,
        description=f"output rate, Hz: {LEAST_RATE_HZ:g} to the rate of the fastest sensor",
    )


class CalibrationsArguments(RequestArguments):
    """``bridge/request/calibrations``."""

    count: int = Field(
        20, ge=1, le=MOST_VERSIONS, description="number of versions to list, the newest first"
    )


class UseCalibrationArguments(RequestArguments):
    """``bridge/request/use-calibration``."""

    version: int | None = Field(
        None, ge=1, le=LAST_VERSION, description="number of a stored version"
    )
    revert: bool = Field(
        False, description="true instead of `version`: the version stored before the one in force"
    )

    @model_validator(mode="after")
    def _check_choice(self) -> UseCalibrationArguments:
        if (self.version is None) is not self.revert:
            raise ValueError('expected either {"version": NUMBER} or {"revert": true}')
        return self


class SelftestArguments(RequestArguments):
    """``bridge/request/selftest``."""


class RecordArguments(RequestArguments):
    """``bridge/request/record``."""

    action: Literal["start", "stop", "status"] = Field(
        description="`start` or `stop` to record; `status` changes nothing"
    )


class PhysicalTestArguments(RequestArguments):
    """``bridge/request/physical-test``."""

    device: str = Field(min_length=1, max_length=256, description="id of a sensor in rig.toml")
    action: Literal["start", "status", "stop"] = Field(
        description="`start` opens the sensor again and begins; `status` changes nothing; `stop` "
        "ends the test, as 30 s without a request do"
    )


class RequestKind(NamedTuple):
    """One request that the daemon accepts."""

    model: type[RequestArguments]
    """Model of the arguments."""
    effect: str
    """Effect of the request, described in one sentence."""


REQUESTS: dict[str, RequestKind] = {
    "calibrate": RequestKind(
        CalibrateArguments, "Begin or abort a calibration phase, or revert online learning."
    ),
    "static": RequestKind(
        StaticArguments, "Record a new static pose, which corrects the headings of the sensors."
    ),
    "mark": RequestKind(MarkArguments, "Label this instant in events and recordings."),
    "reload": RequestKind(ReloadArguments, "Load rig.toml again, as SIGHUP does."),
    "restart-device": RequestKind(
        RestartDeviceArguments, "Close the port of one device and open it again."
    ),
    "rate": RequestKind(
        RateArguments, "Change the output rate until the next reload or restart of the daemon."
    ),
    "calibrations": RequestKind(
        CalibrationsArguments, "List the stored calibrations with their quality."
    ),
    "use-calibration": RequestKind(
        UseCalibrationArguments, "Use a stored calibration again, or the previous one."
    ),
    "selftest": RequestKind(SelftestArguments, "Check devices, clocks, store, broker and host."),
    "record": RequestKind(RecordArguments, "Start or stop recording, or return the state."),
    "physical-test": RequestKind(
        PhysicalTestArguments, "Test world, axes and direction of a sensor by three rotations."
    ),
}
"""All requests by name. The name is the last level of the topic."""
