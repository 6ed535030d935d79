"""Measurement of CPU time: paired runs, medians, and ratios to a fixed loop.

Invariant: a time is a median over repeated runs. It is also given as a ratio to a fixed loop of
plain Python in the same run, because machines differ. The threshold is a multiple of the target, so
only a large slowdown exceeds it.
"""

from __future__ import annotations

import gc
import platform
import statistics
import time
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from bench.framework.experiment import Experiment, Result
from bench.framework.material import THIS_MACHINE

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

LIBRARIES = ("numpy", "scipy", "orjson", "aiomqtt", "python-can")


def timed_result(
    name: str,
    value: float,
    unit: str,
    target: float | None = None,
    threshold: float | None = None,
    *,
    ratio: float | None = None,
    note: str = "",
) -> Result:
    """Return a result for a time or a size, for which smaller values are better."""
    maximum = float("inf") if threshold is None else threshold
    return Result(name, value, maximum, unit=unit, target=target, ratio=ratio, note=note)


def speed_experiment(
    id: str,
    title: str,
    measure: Callable[[bool], list[Result]],
    *,
    in_short_run: bool = True,
    recordings: tuple[str, ...] = (),
    packages: tuple[str, ...] = (),
) -> Experiment:
    """Return an experiment of ``bench.experiments.speed``.

    The argument of `measure` is True in the short run of `make bench`. If `in_short_run` is False,
    the experiment is omitted from this run, for example because it only compares settings.
    """
    return Experiment(
        id,
        title,
        lambda _: measure(False),
        THIS_MACHINE,
        recordings,
        packages,
        timed=True,
        quick_run=(lambda _: measure(True)) if in_short_run else None,
    )


def fixed_loop() -> int:
    """Run a fixed loop of integer arithmetic, which is the reference of all times."""
    total = 0
    for k in range(2000):
        total = (total * 31 + k) & 0xFFFF
    return total


def cpu_s(work: Callable[[], object]) -> float:
    """Return the CPU time of `work` in this thread, s; other processes do not affect it."""
    began = time.thread_time()
    work()
    return time.thread_time() - began


def loop_s(repeats: int = 9) -> float:
    """Return the median CPU time of the fixed loop, s."""
    return statistics.median(cpu_s(fixed_loop) for _ in range(repeats))


def repeats(quick: bool) -> int:
    """Return the number of repetitions for short functions."""
    return 3 if quick else 25


def per_item(
    name: str,
    prepare: Callable[[], Callable[[], object]],
    *,
    items: int,
    goal_us: float | None,
    quick: bool,
    slack: float = 4.0,
    note: str = "",
) -> Result:
    """Return the median CPU time per item; `prepare` makes a new function for each repeat."""
    prepare()()  # warm up
    times, ratios = [], []
    for _ in range(repeats(quick)):
        work = prepare()
        gc.collect()  # collect the garbage of earlier functions
        loop = cpu_s(fixed_loop)
        took = cpu_s(work) / items
        times.append(took)
        ratios.append(took / loop)
    threshold = None if goal_us is None else goal_us * slack
    figure = round(statistics.median(times) * 1e6, 2)
    ratio = round(statistics.median(ratios), 4)
    return timed_result(name, figure, "µs", goal_us, threshold, ratio=ratio, note=note)


def percentile(values: Sequence[float], share: float) -> float:
    """Return the value that `share` of `values` do not exceed (nearest rank)."""
    ranked = sorted(values)
    return ranked[min(len(ranked) - 1, int(share * len(ranked)))]


def machine() -> dict[str, object]:
    """Return processor, system and library versions of this machine, as JSON values."""
    return {
        "processor": _processor(),
        "cores": _cores(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
        "libraries": {name: version(name) for name in LIBRARIES},
        "fixed_loop_us": round(loop_s() * 1e6, 1),
    }


def _cpuinfo() -> list[str]:
    try:
        return Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return []


def _processor() -> str:
    named = [line.partition(":")[2].strip() for line in _cpuinfo() if line.startswith("model name")]
    return named[0] if named else platform.processor() or "unknown"


def _cores() -> int:
    return sum(line.startswith("processor") for line in _cpuinfo())
