"""A recorded run with a static calibration, a mark, a reconnection and a reload.

The bytes of four sensors arrive at simulated times, so the run takes less than a second.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

from typing_extensions import override  # typing has it from Python 3.12

from jointfit_daemon.calibration.phases import run_job
from jointfit_daemon.config import parse_rig
from jointfit_daemon.outputs.recording import Recorder
from jointfit_daemon.pipeline.events import (
    CalibrationReady,
    CalibrationStored,
    Configured,
    FitJob,
    JobFinished,
    Request,
    SourceClosed,
    SourceOpened,
    UnixOffset,
)
from tests.pipeline import core_feed
from tests.pipeline.core_feed import BEGIN_NS, PERIOD_NS, SENSORS, Bench, chunk

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.pipeline.events import Event

UNIX_NS = 1_795_000_000_000_000_000
"""UNIX time of instant 0 of the host clock, ns."""
STATIC_FROM, FITTED, END = 20, 260, 500
"""Sample numbers of the static request, of its result, and of the end of the run."""


def at(number: int) -> int:
    """Return the host time of sample `number`, ns."""
    return BEGIN_NS + number * PERIOD_NS


def rig_table(**head: Any) -> dict[str, Any]:
    """Return the rig.toml of four sensors without cameras."""
    table = core_feed.table(**head)
    del table["mocap"]
    return table | {"calibration": {"static_s": 1.0, "store": "subject-07"}}


@dataclass
class RecordingBench(Bench):
    """A core whose events and outputs are recorded."""

    recorder: Recorder = field(kw_only=True)

    @override
    def give(self, event: Event, now_ns: int) -> None:
        before = len(self.out)
        self.recorder.event(event)
        super().give(event, now_ns)
        for output in self.out[before:]:
            self.recorder.output(output)

    def flush(self) -> None:
        """Write pending events, as the thread of the recorder does twice per second."""
        writer = self.recorder._writer
        assert writer is not None
        writer.write(self.recorder._take())


@dataclass(frozen=True)
class RecordedRun:
    """The files of a recording, and results of the live run."""

    path: Path
    calibration: Calibration
    """Result of the static phase."""
    states: int
    """Number of limb states."""


def samples(first: int, end: int, *, still: bool = False) -> list[Event]:
    """Return the chunks of all sensors, moving or at rest."""
    turning = core_feed.orientation

    def orientation(name: str, number: int) -> tuple[float, float, float, float]:
        return turning(name, 0 if still else number)

    with patch.object(core_feed, "orientation", orientation):
        chunks = [chunk(name, k) for k in range(first, end) for name in SENSORS]
    return sorted(chunks, key=core_feed.arrival_ns)


def record_run(folder: Path) -> RecordedRun:
    """Run a core on simulated bytes and record it in `folder`."""
    bench = RecordingBench(recorder=Recorder(folder, "r"))
    rig = parse_rig(rig_table())
    bench.feed([Configured(BEGIN_NS, rig, None), UnixOffset(BEGIN_NS, UNIX_NS)])
    bench.feed([SourceOpened(BEGIN_NS, source.id) for source in rig.sources])

    bench.feed(samples(0, STATIC_FROM, still=True))
    bench.feed([Request(at(STATIC_FROM), "calibrate", "t1", {"phase": "static"})])
    bench.feed(samples(STATIC_FROM, FITTED, still=True))
    (job,) = [output for output in bench.out if isinstance(output, FitJob)]
    bench.feed([JobFinished(at(FITTED), job.job, run_job(job.work), None)])
    bench.feed([CalibrationStored(at(FITTED + 1), 1)])
    (ready,) = [output for output in bench.out if isinstance(output, CalibrationReady)]

    bench.flush()
    bench.feed(samples(FITTED + 2, 300))
    bench.feed([Request(at(300), "mark", "t2", {"text": "first step"})])
    bench.feed([SourceClosed(at(301), "S1", "lost", "unplugged"), SourceOpened(at(302), "S1")])
    bench.feed(samples(303, 400))
    slower = parse_rig(rig_table(output_rate_hz=80))
    bench.feed([Configured(at(400), slower, ready.calibration, 1, 2.4)])
    bench.feed(samples(401, END))
    bench.recorder.close()
    (_path,) = folder.glob("r-*.mcap")
    return RecordedRun(folder, ready.calibration, len(bench.states))
