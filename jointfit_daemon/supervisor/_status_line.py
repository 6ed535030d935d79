"""The line that ``systemctl status`` shows. Law: what is missing is named, what is well counted."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping

    from jointfit_daemon.config import Source


class Pace:
    """How many limb states came out a second, between two looks."""

    def __init__(self) -> None:
        self._states, self._at_s = 0, float("nan")

    def since(self, states: int, now_s: float) -> float:
        """Return limb states a second since the last look, NaN at the first."""
        passed_s, more = now_s - self._at_s, states - self._states
        self._states, self._at_s = states, now_s
        return more / passed_s if passed_s else float("nan")


@dataclass(frozen=True, slots=True)
class Seen:
    """What the daemon knows of itself just now."""

    online: Collection[str]
    """Ids of the sources that are there."""
    phase: str
    """Of the calibration, as on its topic."""
    pace_hz: float
    """Limb states a second; NaN: not known yet."""
    connected: bool
    """Whether the broker is there."""


def status_line(sources: Iterable[Source], seen: Seen) -> str:
    """Return the state of the rig in one line.

    Parameters
    ----------
    sources
        What rig.toml asks for.
    seen
        What is there of it.
    """
    rig = list(sources)
    imus = [source.id for source in rig if source.kind == "imu"]
    missing = [name for name in imus if name not in seen.online]
    words = [f"{len(imus) - len(missing)} of {len(imus)} IMUs"]
    if missing:
        words.append(f"missing {', '.join(missing)}")
    words += [
        "cameras" if source.id in seen.online else "no cameras"
        for source in rig
        if source.kind == "mocap"
    ]
    words.append(_calibration(seen.phase))
    if not math.isnan(seen.pace_hz):
        words.append(f"{seen.pace_hz:.0f} poses/s")
    if not seen.connected:
        words.append("no broker")
    return ", ".join(words)


def phase_of(health: Mapping[str, object]) -> str:
    """Return the calibration's phase out of what the core tells of itself."""
    told = health.get("calibration")
    return str(told.get("phase", "uncalibrated")) if isinstance(told, dict) else "uncalibrated"


def _calibration(phase: str) -> str:
    return phase if phase in {"calibrated", "uncalibrated"} else f"calibration: {phase}"
