"""Jobs of the worker process and their result.

A job is sent to the worker process as a pickle. Its result is returned and recorded as JSON. This
module imports no fitting code, so that the daemon can create jobs without loading SciPy.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

from jointfit_daemon.limb_model import Calibration

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from jointfit_daemon.calibration._trial import (
        CalibrationSettings,
        CalibrationTrial,
        OnlineFrames,
    )
    from jointfit_daemon.model import Chain


@dataclass(frozen=True, slots=True)
class AlignJob:
    """Estimate the rotation between each sensor's world and the optical world.

    All sensors are on the calibration plate.
    """

    name: ClassVar[str] = "align"

    chain: Chain
    settings: CalibrationSettings
    trial: CalibrationTrial
    lag_ns: Mapping[str, int] | None = None
    """Configured lags by sensor, ns."""


@dataclass(frozen=True, slots=True)
class StaticJob:
    """Fit the sensor-to-segment alignments in the static pose."""

    name: ClassVar[str] = "static"

    chain: Chain
    settings: CalibrationSettings
    static: CalibrationTrial
    alignment: Mapping[str, Any] | None = None
    """JSON form of the `PlateAlignment` of this session; None without an align phase."""
    previous: Calibration | None = None
    """The current calibration."""


@dataclass(frozen=True, slots=True)
class FunctionalJob:
    """Fit joint centers and models to the functional phase."""

    name: ClassVar[str] = "functional"

    chain: Chain
    settings: CalibrationSettings
    static: CalibrationTrial
    functional: CalibrationTrial
    alignment: Mapping[str, Any] | None = None
    """JSON form of the `PlateAlignment` of this session; None without an align phase."""
    previous: Calibration | None = None
    """The current calibration."""
    lag_ns: Mapping[str, int] | None = None
    """Configured lags by sensor, ns."""
    tracked: Mapping[str, tuple[float, float]] | None = None
    """Lags estimated during operation and their standard deviations by sensor, ns."""


@dataclass(frozen=True, slots=True)
class RefitJob:
    """Refit the models to frames that were collected during operation."""

    name: ClassVar[str] = "online"

    chain: Chain
    previous: Calibration
    """The current calibration."""
    fresh: OnlineFrames


CalibrationJob = AlignJob | StaticJob | FunctionalJob | RefitJob


@dataclass(frozen=True, slots=True)
class JobControl:
    """Time and progress of a running job, supplied by the process that runs it."""

    elapsed_s: Callable[[], float] = lambda: 0.0
    """Function that returns the time since the start of the job, s."""
    report: Callable[[float, str], None] = lambda _share, _text: None
    """Function that publishes the progress, 0 to 1, and a sentence that describes the current step.
    """


@dataclass(frozen=True, slots=True)
class FitResult:
    """Result of a job."""

    quality: Mapping[str, Any] = field(default_factory=dict)
    alignment: Mapping[str, Any] | None = None
    """JSON form of the `PlateAlignment` that was fitted."""
    calibration: Calibration | None = None
    worse: str | None = None
    """Reason why the current calibration is better than `calibration`."""
    kept: str | None = None
    """Reason why a refit does not replace the current models."""
    notes: tuple[str, ...] | None = None
    """One sentence for each sensor that moved relative to another sensor of its segment since the
    current calibration. None for other jobs than `StaticJob`, and without a current calibration.
    """
    refused: str | None = None
    """Reason why there is no result; the other fields are then unused."""

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form, which is `refused` alone, or all fields that are not None."""
        if self.refused is not None:
            return {"refused": self.refused}
        table = {
            "alignment": self.alignment,
            "quality": dict(self.quality),
            "notes": None if self.notes is None else list(self.notes),
            "calibration": None if self.calibration is None else self.calibration.to_dict(),
            "worse": self.worse,
            "kept": self.kept,
        }
        return {key: value for key, value in table.items() if value is not None}

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> FitResult:
        """Return the result from its JSON form.

        Raises
        ------
        CalibrationSchemaError
            The calibration in `data` is incomplete or has another schema version.
        """
        stored, notes = data.get("calibration"), data.get("notes")
        return FitResult(
            quality=data.get("quality", {}),
            alignment=data.get("alignment"),
            calibration=None if stored is None else Calibration.from_dict(stored),
            worse=data.get("worse"),
            kept=data.get("kept"),
            notes=None if notes is None else tuple(notes),
            refused=data.get("refused"),
        )
