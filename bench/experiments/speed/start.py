"""Import time of the programs, CPU time of a calibration fit, exposure of the systemd units."""

from __future__ import annotations

import os
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from bench.framework.measurement import speed_experiment, timed_result
from bench.subjects.simulated_wearer import bench_rig, phases
from jointfit_daemon.calibration import FunctionalJob
from jointfit_daemon.calibration.phases import fit_plate_alignment, run_job

if TYPE_CHECKING:
    from bench.framework.experiment import Result

DAEMON = (
    "import jointfit_daemon.__main__, jointfit_daemon.config, jointfit_daemon.supervisor.daemon"
)
CHECKING = "import jointfit_daemon.__main__, jointfit_daemon.config"


def _imported(code: str, count: int) -> float:
    """Return how much longer a Python process with `code` takes than an empty one, s (medians)."""
    took = {code: [], "pass": []}  # type: dict[str, list[float]]
    for _ in range(count):
        for each, times in took.items():
            began = time.perf_counter()
            subprocess.run([sys.executable, "-c", each], check=True)  # noqa: S603 - ours
            times.append(time.perf_counter() - began)
    return statistics.median(took[code]) - statistics.median(took["pass"])


def import_rows(quick: bool) -> list[Result]:
    count = 3 if quick else 9
    return [
        timed_result(
            "start: imports of --check", round(_imported(CHECKING, count), 3), "s", 0.3, 1.5
        ),
        timed_result(
            "start: imports of jointfitd", round(_imported(DAEMON, count), 3), "s", 0.6, 3.0
        ),
    ]


def fit_rows(quick: bool) -> list[Result]:
    """Measure the functional fit in this process, on trials with the durations of the demo."""
    del quick  # one fit is fast enough
    trials, rig = phases(), bench_rig()
    alignment = fit_plate_alignment(trials.align, rig.calibration).to_dict()
    job = FunctionalJob(rig.chain, rig.calibration, trials.static, trials.functional, alignment)
    began = time.thread_time(), time.perf_counter()
    found = run_job(job)
    cpu, wall = time.thread_time() - began[0], time.perf_counter() - began[1]
    assert found.calibration is not None, found.refused
    threads = os.environ.get("OPENBLAS_NUM_THREADS", "all")
    note = f"{wall:.2f} s of wall time, OPENBLAS_NUM_THREADS {threads}"
    return [
        timed_result("fit: 60 s at 100 Hz and 120 Hz", round(cpu, 2), "s", 3.0, 12.0, note=note)
    ]


def exposure_rows(quick: bool) -> list[Result]:
    """Return the exposure of the systemd units by systemd-analyze, from 0 (closed) to 10 (open)."""
    del quick
    tool = shutil.which("systemd-analyze")
    if tool is None:
        print(
            "not run: systemd-analyze is not installed: sudo apt install systemd", file=sys.stderr
        )
        return []
    rows = []
    for unit in sorted((Path(__file__).parents[3] / "systemd").glob("jointfitd*.service")):
        words = [tool, "security", "--offline=yes", "--no-pager", str(unit)]
        said = subprocess.run(words, check=True, capture_output=True, text=True).stdout  # noqa: S603 - systemd's
        figure = float(said.partition("level for")[2].partition(":")[2].split()[0])
        rows.append(timed_result(f"exposure of {unit.name}", figure, "of 10", 1.2, 1.2))
    return rows


EXPERIMENTS = (
    speed_experiment(
        "unit-exposure",
        "Exposure of the shipped systemd units",
        exposure_rows,
    ),
    speed_experiment(
        "start-imports",
        "Start of the programs: imports",
        import_rows,
    ),
    speed_experiment(
        "calibration-fit-time",
        "A calibration fit",
        fit_rows,
    ),
)
