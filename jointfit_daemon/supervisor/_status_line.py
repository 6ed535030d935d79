"""The status line of the service that ``systemctl status`` displays."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from jointfit_daemon.pipeline.events import CalibrationPhase

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from jointfit_daemon.config import Source

_PLAIN_PHASES = (CalibrationPhase.CALIBRATED, CalibrationPhase.UNCALIBRATED)
"""Phases that are displayed without the word "calibration"."""


class FrameRateCounter:
    """Measures the rate of limb states between two calls."""

    def __init__(self) -> None:
        self._states, self._at_s = 0, float("nan")

    def rate_hz(self, states: int, now_s: float) -> float:
        """Return the rate since the last call, 1/s; NaN at the first call."""
        passed_s, more = now_s - self._at_s, states - self._states
        self._states, self._at_s = states, now_s
        return more / passed_s if passed_s else float("nan")


def status_line(
    sources: Sequence[Source],
    online: Collection[str],
    phase: CalibrationPhase,
    rate_hz: float,
    *,
    connected: bool,
) -> str:
    """Return the state of the rig in one line, with counts and the names of missing sensors.

    Parameters
    ----------
    sources
        Sources of rig.toml.
    online
        Ids of the connected sources.
    phase
        Phase of the calibration.
    rate_hz
        Limb states per second; NaN if unknown.
    connected
        Whether the daemon is connected to the broker.
    """
    imus = [source.id for source in sources if source.kind == "imu"]
    missing = [name for name in imus if name not in online]
    words = [f"{len(imus) - len(missing)} of {len(imus)} IMUs"]
    if missing:
        words.append(f"missing {', '.join(missing)}")

    words += [
        "cameras" if source.id in online else "no cameras"
        for source in sources
        if source.kind == "mocap"
    ]
    words.append(phase if phase in _PLAIN_PHASES else f"calibration: {phase}")
    if not math.isnan(rate_hz):
        words.append(f"{rate_hz:.0f} poses/s")
    if not connected:
        words.append("no broker")
    return ", ".join(words)
