"""Input events of a core during a walk, from four IMUs at 100 Hz and cameras at 100 Hz.

Invariant: the events are deterministic and in order of arrival. The module uses no clock and no
processes.
"""

from __future__ import annotations

from heapq import merge
from typing import TYPE_CHECKING

from bench.experiments.speed.core import START_NS, events, worn
from bench.subjects.device_bytes import natnet_datagrams, natnet_opening
from bench.subjects.simulated_wearer import bench_rig
from jointfit_daemon.model import Chunk
from jointfit_daemon.pipeline.events import ChunkArrived, Configured, SourceOpened, Tick

if TYPE_CHECKING:
    from jointfit_daemon.pipeline.events import Event

CAMERA_NS = 10_000_000


def session_events(
    seconds: float, *, cameras: bool = True, silent: tuple[str, float, float] | None = None
) -> list[Event]:
    """Return the events of a calibrated rig, with one tick per second.

    Parameters
    ----------
    seconds : float
        Duration of the session, s.
    cameras : bool
        Whether the motion-capture server sends.
    silent : tuple of str and two floats, optional
        A sensor that sends nothing in one period, and start and end of this period, s.
    """
    frames: list[Event] = []
    opening: list[Event] = [Configured(START_NS, bench_rig(), worn(), 1)]
    if cameras:
        opening.append(SourceOpened(START_NS, "mocap"))
        opening += [ChunkArrived("mocap", Chunk(START_NS, data)) for data in natnet_opening()]
        frames = [
            ChunkArrived("mocap", Chunk(START_NS + k * CAMERA_NS, data))
            for k, data in enumerate(natnet_datagrams(round(seconds * 100), CAMERA_NS), 1)
        ]
    name, begin_s, end_s = silent or ("", 0.0, 0.0)
    begin_ns, end_ns = (START_NS + round(t * 1e9) for t in (begin_s, end_s))
    sensors = [
        event
        for event in events(100.0, seconds)
        if not (
            isinstance(event, ChunkArrived)
            and event.source == name
            and begin_ns <= event.chunk.t_ns < end_ns
        )
    ]
    ticks = [Tick(START_NS + k * 1_000_000_000) for k in range(1, round(seconds) + 2)]
    return [*opening, *merge(sensors, frames, ticks, key=_instant)]


def _instant(event: Event) -> int:
    return event.chunk.t_ns if isinstance(event, ChunkArrived) else event.t_ns
