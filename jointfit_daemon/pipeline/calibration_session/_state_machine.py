"""States of the calibration session and their transitions.

The diagram in docs/calibration.md is generated from :data:`TRANSITIONS`.

Invariant: a transition that is not in the table raises an error, so no event is ignored silently.
"""

from __future__ import annotations

from enum import StrEnum

from jointfit_daemon.pipeline.events import CalibrationPhase

COLLECTING = (CalibrationPhase.ALIGN, CalibrationPhase.STATIC, CalibrationPhase.FUNCTIONAL)
"""Phases that record a trial. Each of them starts with a request."""
RESTING = (
    CalibrationPhase.UNCALIBRATED,
    CalibrationPhase.ALIGNED,
    CalibrationPhase.POSED,
    CalibrationPhase.CALIBRATED,
    CalibrationPhase.ABORTED,
)
"""Phases in which a new phase may start, because neither a recording nor a fit is running."""


class SessionEvent(StrEnum):
    """Events that change the phase of the session."""

    START_ALIGN = "align requested"
    START_STATIC = "static requested"
    START_FUNCTIONAL = "functional requested"
    RECORDED = "trial recorded"
    ALIGNMENT_FITTED = "alignment fitted"
    POSE_FITTED = "pose fitted"
    CALIBRATION_FITTED = "calibration fitted"
    RESULT_WORSE = "result rejected as worse"
    FAILED = "aborted or refused"


START = {
    CalibrationPhase.ALIGN: SessionEvent.START_ALIGN,
    CalibrationPhase.STATIC: SessionEvent.START_STATIC,
    CalibrationPhase.FUNCTIONAL: SessionEvent.START_FUNCTIONAL,
}
"""Event that starts each phase."""

TRANSITIONS: dict[tuple[CalibrationPhase, SessionEvent], CalibrationPhase] = {
    **{(phase, START[wanted]): wanted for phase in RESTING for wanted in COLLECTING},
    **{(phase, SessionEvent.RECORDED): CalibrationPhase.FITTING for phase in COLLECTING},
    **{(phase, SessionEvent.FAILED): CalibrationPhase.ABORTED for phase in COLLECTING},
    (CalibrationPhase.FITTING, SessionEvent.ALIGNMENT_FITTED): CalibrationPhase.ALIGNED,
    (CalibrationPhase.FITTING, SessionEvent.POSE_FITTED): CalibrationPhase.POSED,
    (CalibrationPhase.FITTING, SessionEvent.CALIBRATION_FITTED): CalibrationPhase.CALIBRATED,
    (CalibrationPhase.FITTING, SessionEvent.RESULT_WORSE): CalibrationPhase.CALIBRATED,
    (CalibrationPhase.FITTING, SessionEvent.FAILED): CalibrationPhase.ABORTED,
}
"""Next phase, by current phase and event."""
