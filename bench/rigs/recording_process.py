"""Process that records four sensors at 400 Hz and limb states at 100 Hz.

    python -m bench.rigs.recording_process FOLDER [--seconds S] [--file-seconds S] [--stamps]
        [--without-recorder]

The process ends after S seconds, or when it is killed. It prints ``ready`` when the input starts.
At the end, it prints JSON with its CPU time, elapsed time, number of input bytes and peak memory.
With ``--stamps``, it also prints the time (CLOCK_MONOTONIC, ns) ten times per second. After a kill,
the last printed time is compared with the last recorded time.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import time
from contextlib import suppress
from pathlib import Path

from jointfit_daemon.model import Chunk, LimbState
from jointfit_daemon.outputs.recording import Recorder, RecordingLimits
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import ChunkArrived
from tests.pipeline.core_feed import SENSORS, chunk, opening

RATE_HZ, STATES_HZ = 400, 100
PERIOD_S = 0.01
"""Time between two inputs, s. Each input has four samples of each sensor and one state."""
STAMP_FEEDS = 10
"""Number of inputs between two printed stamps."""
PREPARED = 400
"""Number of prepared samples of each sensor, which are repeated."""


def prepared_chunks() -> list[list[tuple[str, bytes]]]:
    """Return source and bytes of the chunks of every sample number."""
    samples = [[chunk(name, number) for name in SENSORS] for number in range(PREPARED)]
    return [[(event.source, event.chunk.data) for event in row] for row in samples]


def prepared_states() -> list[LimbState]:
    """Return the limb states of a core that processes these samples."""
    core, states = Core(), []
    for event in opening(mocap=False):
        core.feed(event)
    for number in range(100):
        for name in SENSORS:
            states += core.feed(chunk(name, number))
    return [state for state in states if isinstance(state, LimbState)]


def peak_memory_kib() -> int:
    """Return the peak resident memory, KiB; getrusage would include the parent's memory."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(status.partition("VmHWM:")[2].split()[0])


async def record(options: argparse.Namespace) -> None:
    """Send the input to the recorder in real time, and print the cost."""
    samples, states = prepared_chunks(), prepared_states()
    limits = RecordingLimits(file_s=options.file_seconds)
    recorder = Recorder(options.folder, "rig", limits, autostart=False)
    for event in opening(mocap=False):
        recorder.event(event)
    task = asyncio.create_task(recorder.run(), name="recorder")
    await asyncio.sleep(0.1)
    if not options.without_recorder:
        await recorder.start()

    print("ready", flush=True)
    began_s, cpu_s, raw_bytes = time.monotonic(), time.process_time(), 0
    per_feed = round(RATE_HZ * PERIOD_S)
    for feed in range(round(options.seconds / PERIOD_S)):
        await asyncio.sleep(max(0.0, began_s + feed * PERIOD_S - time.monotonic()))
        for number in range(feed * per_feed, (feed + 1) * per_feed):
            for source, data in samples[number % PREPARED]:
                recorder.event(ChunkArrived(source, Chunk(time.monotonic_ns(), data)))
                raw_bytes += len(data)
        recorder.output(states[feed % len(states)]._replace(completed_ns=time.monotonic_ns()))
        if options.stamps and feed % STAMP_FEEDS == 0:
            print(time.monotonic_ns(), flush=True)

    cost = {
        "cpu_s": time.process_time() - cpu_s,
        "elapsed_s": time.monotonic() - began_s,
        "raw_bytes": raw_bytes,
        "memory_kib": peak_memory_kib(),
    }
    task.cancel()
    with suppress(asyncio.CancelledError):
        await task
    print(json.dumps(cost), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--file-seconds", type=float, default=3600.0)
    parser.add_argument("--stamps", action="store_true")
    parser.add_argument("--without-recorder", action="store_true")
    asyncio.run(record(parser.parse_args()))


if __name__ == "__main__":
    main()
