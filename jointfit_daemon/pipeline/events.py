"""What goes into the core and what comes out of it. Law: frozen data, nothing else.

Everything that can change what the core does is one of the input events below, so a log of them,
fed to a fresh core, gives the same outputs again.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from jointfit_daemon.model import LimbState

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.config import Rig
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import Chunk

# --- in ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Configured:
    """A rig was loaded: the first event of all, and again at every reload."""

    t_ns: int
    rig: Rig
    calibration: Calibration | None
    """What the store held for this rig."""
    calibration_version: int | None = None
    calibration_age_s: float = 0.0
    """How long ago it was stored, s: its headings have wandered since."""


@dataclass(frozen=True, slots=True)
class SourceOpened:
    """A driver began to run: what it emits from here on goes to a fresh decoder."""

    t_ns: int
    source: str


@dataclass(frozen=True, slots=True)
class SourceClosed:
    """A driver ended: lost (tried again) or misconfigured (stays away) or removed by a reload."""

    t_ns: int
    source: str
    reason: Literal["lost", "misconfigured", "removed"]
    text: str


@dataclass(frozen=True, slots=True)
class ChunkArrived:
    """Bytes of one source."""

    source: str
    chunk: Chunk


@dataclass(frozen=True, slots=True)
class Tick:
    """Time went on without anything arriving: the core's deadline, or a shell's heartbeat."""

    t_ns: int


@dataclass(frozen=True, slots=True)
class Request:
    """Somebody asked for something; arguments were validated at the edge."""

    t_ns: int
    command: str
    """``calibrate`` so far."""
    transaction: str
    arguments: Mapping[str, object]


@dataclass(frozen=True, slots=True)
class JobFinished:
    """The worker ended a job: `result` as the job's kind defines it, or `error` says why not."""

    t_ns: int
    job: int
    result: Mapping[str, object] | None
    error: str | None


@dataclass(frozen=True, slots=True)
class CalibrationStored:
    """The store wrote the calibration that ``CalibrationReady`` handed out."""

    t_ns: int
    version: int


@dataclass(frozen=True, slots=True)
class UnixOffset:
    """UNIX time minus CLOCK_MONOTONIC: at the start, and whenever it is another.

    They run at the same rate, so another one means that UNIX time was set, or that the host slept.
    """

    t_ns: int
    offset_ns: int


Event = (
    Configured
    | SourceOpened
    | SourceClosed
    | ChunkArrived
    | Tick
    | Request
    | JobFinished
    | CalibrationStored
    | UnixOffset
)

# --- out --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Notice:
    """A change of state worth telling: goes to ``bridge/event`` and the log."""

    t_ns: int
    kind: str
    """``device`` | ``sensor`` | ``clock`` | ``calibration`` | ``wire`` | ``reload`` |
    ``frames``."""
    id: str
    text: str
    level: Literal["info", "warning", "error"] = "info"
    data: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DeviceStatus:
    """Availability of one device; retained."""

    id: str
    online: bool


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """What a device said of itself; retained."""

    id: str
    data: Mapping[str, object]


@dataclass(frozen=True, slots=True)
class CalibrationStatus:
    """Phase and quality of the calibration; retained."""

    t_ns: int
    phase: str
    """``uncalibrated``, ``align``, ``aligned``, ``static``, ``posed``, ``functional``,
    ``fitting``, ``calibrated`` or ``aborted``."""
    text: str
    version: int | None = None
    """Of the calibration in force; None while there is none, or it is not stored (yet)."""
    quality: Mapping[str, object] = field(default_factory=dict)
    """Figures of what just ended, else of the calibration in force."""
    kept: str | None = None
    """Why the result that just came was not taken and the calibration in force stays."""
    refused: Mapping[str, object] = field(default_factory=dict)
    """Figures of the result that was not taken."""

    @property
    def level(self) -> Literal["info", "warning"]:
        """Return how much attention it needs: a result that was refused or aborted needs some."""
        return "warning" if self.phase == "aborted" or self.kept is not None else "info"


@dataclass(frozen=True, slots=True)
class CalibrationProgress:
    """How far the running phase is; at most 5 a second."""

    t_ns: int
    phase: str
    progress: float
    """0 to 1."""
    text: str
    data: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class FitJob:
    """Work for the worker process: ``calibration.jobs.run_job(kind, payload)``, all picklable."""

    job: int
    kind: str
    payload: Mapping[str, object]


@dataclass(frozen=True, slots=True)
class CancelJob:
    """The result of this job is no longer wanted: stop the worker."""

    job: int


@dataclass(frozen=True, slots=True)
class CalibrationReady:
    """A calibration to be stored; answered with ``CalibrationStored``."""

    calibration: Calibration


@dataclass(frozen=True, slots=True)
class Reply:
    """The answer to a request: exactly one each."""

    command: str
    transaction: str
    status: Literal["ok", "accepted", "error"]
    data: Mapping[str, object] = field(default_factory=dict)
    error: Mapping[str, object] | None = None


Output = (
    LimbState
    | Notice
    | DeviceStatus
    | DeviceInfo
    | CalibrationStatus
    | CalibrationProgress
    | FitJob
    | CancelJob
    | CalibrationReady
    | Reply
)
