"""A killed process loses at most the last second of its recording, and nothing before it."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import pytest
from mcap.reader import make_reader

from jointfit_daemon.outputs.recording import (
    RecordedMessage,
    RecordingGap,
    open_recording,
    repair_recording,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

ROOT = Path(__file__).resolve().parents[3]
LONGEST_LOSS_S = 1.0
PROCESSES = 4
"""Number of processes that record at the same time."""


class KilledRecording(NamedTuple):
    """Content of the file of a killed process."""

    lost_s: float
    messages: int
    gaps: int
    late_s: float
    """Longest time between recorded chunks, s, by which `lost_s` may exceed `LONGEST_LOSS_S`."""


def kill_one(folder: Path, after_s: float) -> KilledRecording:
    """Kill a process that records after some time, and read its file."""
    command = [sys.executable, "-m", "bench.rigs.recording_process", str(folder)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        began_ns = time.monotonic_ns()
        time.sleep(after_s)
        killed_ns = time.monotonic_ns()
        process.send_signal(signal.SIGKILL)

    (path,) = folder.iterdir()
    messages = list(open_recording(path).messages())
    found = [one for one in messages if isinstance(one, RecordedMessage)]
    sequences = [one.sequence for one in found if not one.channel.startswith("snapshot/")]
    assert sequences == list(range(len(sequences)))
    arrivals_ns = [began_ns]
    arrivals_ns += [one.t_ns for one in found if one.channel.startswith("source/")]
    late_ns = max((b - a for a, b in pairwise(arrivals_ns)), default=0)
    gaps = sum(isinstance(one, RecordingGap) for one in messages)

    if found:
        clean = folder / "clean.mcap"
        repair_recording(path, clean)
        with clean.open("rb") as file:
            assert len(list(make_reader(file).iter_messages())) == len(messages)
    lost_s = (killed_ns - arrivals_ns[-1]) * 1e-9
    return KilledRecording(lost_s, len(sequences), gaps, late_ns * 1e-9)


def kill_many(folder: Path, moments_s: Sequence[float]) -> list[KilledRecording]:
    """Kill one process at each moment; `PROCESSES` of them run at the same time."""
    folders = [folder / str(number) for number in range(len(moments_s))]
    for one in folders:
        one.mkdir()
    with ThreadPoolExecutor(PROCESSES) as pool:
        return list(pool.map(kill_one, folders, moments_s))


@pytest.mark.system
@pytest.mark.parametrize(
    "moments_s",
    [
        # If the recorder wrote only every two seconds, one of these kills would lose too much.
        pytest.param([0.3, 0.9, 1.8, 2.7], id="4"),
        pytest.param(
            [random.Random(number).uniform(0.02, 3.0) for number in range(100)], id="100",
            marks=[pytest.mark.experiment, pytest.mark.timeout(900)],
        ),
    ],
)  # fmt: skip
def test_a_kill_at_a_random_moment_loses_at_most_a_second(
    tmp_path: Path, moments_s: list[float]
) -> None:
    killed = kill_many(tmp_path, moments_s)
    assert [one.gaps for one in killed] == [0] * len(killed)
    print(f"largest loss {max(one.lost_s for one in killed):.2f} s")
    assert [one for one in killed if one.lost_s > LONGEST_LOSS_S + one.late_s] == []
