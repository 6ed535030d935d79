"""Plays a recording at a given speed; prints a time line, and publishes payloads to a broker."""

from __future__ import annotations

import asyncio
import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import typer

from jointfit_daemon.model import LimbState
from jointfit_daemon.pipeline.events import CalibrationStatus, ChunkArrived, Configured, Notice
from jointfit_daemon.tools.replay._publication import Publication
from jointfit_daemon.tools.stop_signals import cancel_on_signal
from jointfit_daemon.units import NS_PER_S

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.pipeline.events import Output
    from jointfit_daemon.reprocessing import Changes

_YIELD_EVENTS = 200
"""Number of events after which other tasks can run, at the highest speed."""


@dataclass(slots=True)
class PlaySummary:
    """Counts and duration of a replay."""

    rig: str = ""
    events: int = 0
    states: int = 0
    """Number of limb states."""
    seconds: float = 0.0
    """Recorded time, s."""
    took_s: float = 0.0
    dropped: int = 0
    """Number of messages that the broker did not accept."""
    settings: str = "as recorded"
    """Text about the rig and the calibration of the replay."""

    def add(self, seconds: float, outputs: list[Output]) -> None:
        """Count the outputs of an event at the recorded time `seconds`."""
        self.events += 1
        self.states += sum(isinstance(output, LimbState) for output in outputs)
        self.seconds = max(self.seconds, seconds)

    def table(self) -> dict[str, object]:
        """Return the summary as a table of names and values."""
        return {
            "rig": self.rig, "events": self.events, "states": self.states, "seconds": self.seconds,
            "took_s": self.took_s, "settings": self.settings, "dropped": self.dropped,
        }  # fmt: skip

    def text(self) -> str:
        """Return the summary as a sentence."""
        factor = self.seconds / self.took_s if self.took_s else math.inf
        lost = f"; the broker did not accept {self.dropped} messages" if self.dropped else ""
        return (
            f"{self.rig}: {self.states} limb states from {self.events} events, "
            f"{self.settings}: {self.seconds:.1f} s in {self.took_s:.1f} s ({factor:.0f} × real "
            f"time){lost}"
        )


async def play_recording(
    file: Path,
    changes: Changes,
    speed: float,
    destination: tuple[str | None, str | None] | None = None,
    *,
    quiet: bool = False,
) -> PlaySummary:
    """Process a recording at a given speed as the daemon does, and return a summary.

    Parameters
    ----------
    file
        Path of the recording.
    changes
        Differences from the recorded run.
    speed
        Factor of the recorded speed; infinity selects the highest possible speed.
    destination
        Base topic and broker for the publication; None in the tuple selects the default. Without a
        destination, nothing is published.
    quiet
        Whether to omit the time line.

    Raises
    ------
    ValueError
        The recording or the destination is invalid.
    BrokerLostError
        The broker does not answer.
    """
    from jointfit_daemon.outputs.recording import read_events
    from jointfit_daemon.reprocessing import process_events

    summary = PlaySummary(settings="processed again" if changes.any else "as recorded")
    pace = _Pace(speed)
    publication: Publication | None = None
    with cancel_on_signal() as stop:
        try:
            for event, outputs in process_events(read_events(file), changes):
                if isinstance(event, Configured):
                    summary.rig = event.rig.name
                    if destination is not None and publication is None:
                        publication = Publication(event.rig, *destination)
                        await publication.start()

                t_ns = event.chunk.t_ns if isinstance(event, ChunkArrived) else event.t_ns
                await pace.wait(t_ns)
                if publication is not None:
                    await publication.publish(t_ns, event, outputs)
                summary.add(pace.seconds(t_ns), outputs)
                if not quiet:
                    _print_time_line(pace.seconds(t_ns), outputs)
        except asyncio.CancelledError:
            if stop.number is None:
                raise
            raise typer.Exit(stop.exit_code) from None
        finally:
            if publication is not None:
                await publication.stop()
                summary.dropped = publication.dropped
    summary.took_s = pace.took_s
    return summary


class _Pace:
    """Timer that waits until the time of a recorded event is due."""

    def __init__(self, speed: float) -> None:
        self._speed, self._began_s = speed, time.monotonic()
        self._first_ns: int | None = None
        self._events = 0

    async def wait(self, t_ns: int) -> None:
        """Wait until `t_ns` is due; let other tasks run at intervals."""
        if self._first_ns is None:
            self._first_ns, self._began_s = t_ns, time.monotonic()
        self._events += 1
        ahead_s = 0.0
        if self._speed < math.inf:
            due_s = self._began_s + self.seconds(t_ns) / self._speed
            ahead_s = due_s - time.monotonic()
        if ahead_s > 0.0 or self._events % _YIELD_EVENTS == 0:
            await asyncio.sleep(max(0.0, ahead_s))

    def seconds(self, t_ns: int) -> float:
        """Return the time since the first event, s."""
        return (t_ns - (self._first_ns or t_ns)) / NS_PER_S

    @property
    def took_s(self) -> float:
        """Time since the first event was processed, s."""
        return time.monotonic() - self._began_s


def _print_time_line(seconds: float, outputs: list[Output]) -> None:
    for output in outputs:
        if isinstance(output, Notice):
            typer.echo(f"{seconds:9.3f} s  {output.kind} {output.id}: {output.text}")
        elif isinstance(output, CalibrationStatus):
            typer.echo(f"{seconds:9.3f} s  calibration {output.phase}: {output.text}")
