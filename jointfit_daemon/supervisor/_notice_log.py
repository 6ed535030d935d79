"""Log lines for the core's notices about sources, sensors and calibrations."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING

from jointfit_daemon.outputs.log import journal_fields
from jointfit_daemon.pipeline.events import (
    CalibrationPhase,
    CalibrationStatus,
    DeviceStatus,
    Notice,
    NoticeLevel,
)
from jointfit_daemon.supervisor._calibration_store import store_of
from jointfit_daemon.supervisor._outage_lines import OutageLines

if TYPE_CHECKING:
    from jointfit_daemon.config import Rig
    from jointfit_daemon.pipeline.events import Event, Output

log = logging.getLogger(__name__)

CLOSED_S = 1.0
"""Longest time between the end of a source's permitted silence and the report that it was closed,
s."""
LEVELS = {
    NoticeLevel.INFO: logging.INFO,
    NoticeLevel.WARNING: logging.WARNING,
    NoticeLevel.ERROR: logging.ERROR,
}
"""Log level for each level of a notice."""


class NoticeLog:
    """Writes the log lines; a `Sink` of the core.

    Parameters
    ----------
    rig
        The current rig.

    Attributes
    ----------
    online
        Ids of the sources that are connected.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._outages = OutageLines()
        self._version: int | None = None
        self.online: set[str] = set()

    def configure(self, rig: Rig) -> None:
        """Use another rig. Sources that `rig` does not contain no longer count as online."""
        self._rig = rig
        self.online &= {source.id for source in rig.sources}

    def event(self, event: Event) -> None:
        """Do nothing, because inputs of the core are not logged."""

    def output(self, output: Output) -> None:
        """Write the log lines of one output."""
        match output:
            case Notice():
                wait_s = self._closes_within(output.id)
                if not self._outages.holds(output, time.monotonic(), wait_s):
                    _write(output)
            case CalibrationStatus():
                self._write_status(output)
            case DeviceStatus(name, online):
                self._outages.close(name)
                (self.online.add if online else self.online.discard)(name)

    def write_due(self, now_s: float, *, stalled: bool) -> None:
        """Write the delayed lines that are due at `now_s`.

        `stalled` states that the event loop was delayed. The lines are then delayed further.
        """
        if stalled:
            self._outages.postpone(now_s)
        for notice in self._outages.due(now_s):
            _write(notice)

    def _write_status(self, status: CalibrationStatus) -> None:
        """Log a change of the calibration, with the file in which it is stored."""
        phase, text, version = status.phase, status.text, status.version
        if phase == CalibrationPhase.FITTING:
            text = text.partition("; ")[0]  # the remarks are notices with their own lines
        if version is not None and version != self._version:
            path = store_of(self._rig).path(version)
            named = f"version {version}"
            text = f"{text} ({path if text.endswith(named) else f'{named} in {path}'})"
        self._version = version

        title = "calibration" if text == phase else f"calibration {phase}"
        fields = journal_fields("calibration", phase)
        log.log(LEVELS[status.level], "%s: %s", title, text, extra=fields)

    def _closes_within(self, name: str) -> float | None:
        """Return the time after which a silent source will be closed, s; None if it is closed."""
        if name not in self.online:
            return None
        settings = [source.settings for source in self._rig.sources if source.id == name]
        return max((getattr(one, "silence_s", 0.0) for one in settings), default=0.0) + CLOSED_S


def _write(notice: Notice) -> None:
    fields = journal_fields(notice.kind, notice.id)
    log.log(LEVELS[notice.level], "%s: %s", notice.id, notice.text, extra=fields)
