"""Calibration session: state machine, recording of the phases, stillness in the static pose."""

from jointfit_daemon.pipeline.calibration_session._session import CalibrationSession

__all__ = ["CalibrationSession"]
