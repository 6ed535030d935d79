"""The status line of the service, as ``systemctl status`` shows it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping

    from jointfit_daemon.config import Source


class FrameRateCounter:
    """Rate of limb states between two calls."""

    def __init__(self) -> None:
        self._states, self._at_s = 0, float("nan")

    def rate_hz(self, states: int, now_s: float) -> float:
        """Return the rate since the last call, 1/s; NaN at the first call."""
        passed_s, more = now_s - self._at_s, states - self._states
        self._states, self._at_s = states, now_s
        return more / passed_s if passed_s else float("nan")


@dataclass(frozen=True, slots=True)
class ServiceStatus:
    """State of the daemon at one instant."""

    online: Collection[str]
    """Ids of the connected sources."""
    phase: str
    """Phase of the calibration, as on its topic."""
    rate_hz: float
    """Limb states per second; NaN if unknown."""
    connected: bool
    """Whether the broker is connected."""


def status_line(sources: Iterable[Source], status: ServiceStatus) -> str:
    """Return the state of the rig in one line: counts, and the names of missing sensors.

    Parameters
    ----------
    sources
        Sources of rig.toml.
    status
        Present state.
    """
    rig = list(sources)
    imus = [source.id for source in rig if source.kind == "imu"]
    missing = [name for name in imus if name not in status.online]
    words = [f"{len(imus) - len(missing)} of {len(imus)} IMUs"]
    if missing:
        words.append(f"missing {', '.join(missing)}")

    words += [
        "cameras" if source.id in status.online else "no cameras"
        for source in rig
        if source.kind == "mocap"
    ]
    plain = status.phase in {"calibrated", "uncalibrated"}
    words.append(status.phase if plain else f"calibration: {status.phase}")
    if not math.isnan(status.rate_hz):
        words.append(f"{status.rate_hz:.0f} poses/s")
    if not status.connected:
        words.append("no broker")
    return ", ".join(words)


def phase_of(health: Mapping[str, object]) -> str:
    """Return the phase of the calibration in the health of the core."""
    calibration = health.get("calibration")
    phase = calibration.get("phase") if isinstance(calibration, dict) else None
    return "uncalibrated" if phase is None else str(phase)
