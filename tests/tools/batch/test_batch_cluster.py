"""`jointfit batch` completes if a Dask worker is killed, and its memory use has a limit."""

from __future__ import annotations

import multiprocessing
import os
import resource
import signal
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.tools.batch import executors
from jointfit_daemon.tools.batch.executors import run_in_pool, run_on_cluster
from jointfit_daemon.tools.batch.find_recordings import find_recordings
from jointfit_daemon.tools.batch.recording_task import RecordingTask
from tests.tools.batch.deadly_task import process_or_die

if TYPE_CHECKING:
    from collections.abc import Callable

    Recordings = Callable[[int], Path]

pytestmark = [pytest.mark.system, pytest.mark.experiment, pytest.mark.timeout(600)]


@pytest.mark.filterwarnings("ignore")  # the package distributed causes warnings
def test_every_recording_is_processed_once_though_a_worker_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed = pytest.importorskip("distributed", reason="distributed is not installed")
    monkeypatch.setattr(executors, "process_recording", process_or_die)
    tasks = [RecordingTask(f"t{k}", (), str(tmp_path), ("report",), ()) for k in range(24)]
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        names = []
        for result in run_on_cluster(tasks, cluster.scheduler_address):
            names.append(result.recording)
            assert result.status == "done", result.error
            if len(names) == 4:
                victim = next(iter(cluster.workers.values()))
                os.kill(victim.pid, signal.SIGKILL)
    assert sorted(names) == sorted(task.name for task in tasks)


def test_memory_stays_flat_over_many_recordings(recordings: Recordings, tmp_path: Path) -> None:
    tasks = find_recordings(recordings(150), tmp_path / "out", ("report",), ())
    peaks_kb = []
    for number, result in enumerate(run_in_pool(tasks, 2)):
        assert result.status == "done", result.error
        if number in (29, 149):
            peaks_kb.append(worker_kb() + own_kb())
    assert peaks_kb[1] < 1.1 * peaks_kb[0] + 10_000, peaks_kb


def own_kb() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def worker_kb() -> int:
    """Return the largest resident memory of a child process so far, kB."""
    children = [child.pid for child in multiprocessing.active_children()]
    found = []
    for pid in children:
        status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
        found.append(int(status.partition("VmHWM:")[2].split()[0]))
    return max(found)
