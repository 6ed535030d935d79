"""Print the variant of this process, then all outputs of a core for four sensors and cameras.

A program of its own: the variant of a process does not change after its first import.
"""

from __future__ import annotations

from heapq import merge

from bench.experiments.speed.core import START_NS, events, worn
from bench.subjects.device_bytes import natnet_datagrams, natnet_opening
from bench.subjects.simulated_wearer import bench_rig
from jointfit_daemon.model import Chunk, LimbState
from jointfit_daemon.outputs.payloads import encode_pose
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import ChunkArrived, Configured, Event, SourceOpened, Tick
from jointfit_variant import running_variant

SECONDS = 6.0
CAMERA_NS = 10_000_000
SILENT = ("S2", 3.0, 4.0)
"""Sensor without data, from and to, s."""


def all_events() -> list[Event]:
    """Return the events of sensors and cameras in order of arrival, and a tick a second."""
    opening: list[Event] = [SourceOpened(START_NS, "mocap")]
    opening += [ChunkArrived("mocap", Chunk(START_NS, data)) for data in natnet_opening()]
    frames = natnet_datagrams(round(SECONDS * 1e9) // CAMERA_NS, CAMERA_NS)
    cameras = [
        ChunkArrived("mocap", Chunk(START_NS + k * CAMERA_NS, data))
        for k, data in enumerate(frames, 1)
    ]
    sensors = events(100.0, SECONDS)
    name, begin_s, end_s = SILENT
    begin_ns, end_ns = (START_NS + round(t * 1e9) for t in (begin_s, end_s))
    heard: list[Event] = [
        event
        for event in sensors
        if not (
            isinstance(event, ChunkArrived)
            and event.source == name
            and begin_ns <= event.chunk.t_ns < end_ns
        )
    ]
    ticks = [Tick(START_NS + k * 1_000_000_000) for k in range(1, round(SECONDS) + 2)]
    return [*opening, *merge(heard, cameras, ticks, key=_instant)]


def _instant(event: Event) -> int:
    return event.chunk.t_ns if isinstance(event, ChunkArrived) else event.t_ns


def main() -> None:
    """Run a core and print every output in a line."""
    print(running_variant())
    core = Core()
    rig = bench_rig()
    print(worn().to_dict())
    for event in [Configured(START_NS, rig, worn(), 1), *all_events()]:
        for output in core.feed(event):
            if isinstance(output, LimbState):
                print(encode_pose(output, START_NS, 2 * START_NS))
            else:
                print(repr(output))
        print(core.next_deadline_ns)
    print(core.health(START_NS + round(SECONDS * 1e9)))


if __name__ == "__main__":
    main()
