"""Latency while other programs use all cores, with the priorities that systemd can set.

Programs in another session compute without pause; their number is twice the number of cores. For
comparison, one setting has no such programs. The settings of the daemon are measured in turn. The
other parts of the measurement (devices, broker, subscriber) have real-time priority in all
settings, so only the daemon waits for a core.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bench.experiments.speed.gateway import running_mosquitto
from bench.framework.measurement import percentile, speed_experiment, timed_result
from bench.rigs.gateway import Load, running_gateway
from tests.broker_fixture import MosquittoBroker

if TYPE_CHECKING:
    from collections.abc import Iterator

    from bench.framework.experiment import Result
    from bench.rigs.gateway import Gateway

ROUNDS, QUICK_ROUNDS = 4, 1
ROUND_S, ADAPT_S = 6.0, 0.5
"""Duration of a measurement, and time from a change of the priority to the measurement, s."""
LOAD = Load(100.0)
PROGRAMS_PER_CORE = 2
LONGEST_S = 60.0
"""Time after which a program ends by itself, if this process was killed, s."""
COMPUTE = (
    f"import time; end_s = time.monotonic() + {LONGEST_S}\n"
    "while time.monotonic() < end_s: sum(range(10000))"
)
UNIT_NICE = -10
"""``Nice=`` of the unit."""
PRIORITY = 10
"""Real-time priority, from 1 to 99."""
REAL_TIME = os.SCHED_RR | os.SCHED_RESET_ON_FORK
"""Policy of the drop-in: threads and processes that a thread starts do not inherit it."""
CORES = sorted(os.sched_getaffinity(0))


@dataclass(frozen=True)
class Setting:
    """Priority and cores of the daemon, and whether other programs compute."""

    name: str
    busy: bool = True
    nice: int = 0
    session_nice: int = 0
    """Priority of the session among sessions (autogroup), which ``nice`` does not change."""
    real_time: bool = False
    """Whether the main thread has real-time priority."""
    one_core: bool = False


SETTINGS = (
    Setting("no other programs", busy=False),
    Setting("default priority"),
    Setting("Nice=-10", nice=UNIT_NICE),
    Setting("Nice=-10, session above other sessions", nice=UNIT_NICE, session_nice=UNIT_NICE),
    Setting("CPUAffinity=0", one_core=True),
    Setting("CPUSchedulingPolicy=rr", real_time=True),
)


@contextlib.contextmanager
def programs(number: int) -> Iterator[None]:
    """Run programs that compute without pause, in a session of their own."""
    script = " ".join(f'"{sys.executable}" -c "{COMPUTE}" &' for _ in range(number)) + " wait"
    shell = subprocess.Popen(["/bin/sh", "-c", script], start_new_session=True)  # noqa: S603 - ours
    try:
        yield
    finally:
        os.killpg(shell.pid, 15)
        shell.wait()


def threads_of(pid: int) -> list[int]:
    """Return the thread ids of a process."""
    return [int(thread.name) for thread in Path(f"/proc/{pid}/task").iterdir()]


def raise_priority(pid: int) -> None:
    """Give all threads of a process real-time priority."""
    for thread in threads_of(pid):
        os.sched_setscheduler(thread, REAL_TIME, os.sched_param(PRIORITY))


def apply(setting: Setting, pid: int) -> None:
    """Set the priority and the cores of the daemon."""
    Path(f"/proc/{pid}/autogroup").write_text(f"{setting.session_nice}\n", "ascii")
    cores = CORES[:1] if setting.one_core else CORES
    for thread in threads_of(pid):
        os.setpriority(os.PRIO_PROCESS, thread, setting.nice)
        os.sched_setaffinity(thread, cores)
    policy, priority = (REAL_TIME, PRIORITY) if setting.real_time else (os.SCHED_OTHER, 0)
    os.sched_setscheduler(pid, policy, os.sched_param(priority))


async def measure(gateway: Gateway, setting: Setting) -> list[float]:
    """Return the latencies of a round, ms."""
    with programs(PROGRAMS_PER_CORE * len(CORES)) if setting.busy else contextlib.nullcontext():
        apply(setting, gateway.pid)
        await asyncio.sleep(ADAPT_S)
        gateway.heard.latencies_ms.clear()
        await asyncio.sleep(ROUND_S)
        return gateway.heard.latencies_ms[:]


async def run(rounds: int) -> dict[Setting, list[float]]:
    """Return the latencies with every setting, ms."""
    found: dict[Setting, list[float]] = {setting: [] for setting in SETTINGS}
    with tempfile.TemporaryDirectory(prefix="jointfit-bench-") as temporary:
        folder = Path(temporary)
        with running_mosquitto(folder) as broker:
            async with running_gateway(folder, broker.port, LOAD) as gateway:
                devices = gateway.hardware.process
                assert devices is not None
                try:
                    for pid in (os.getpid(), broker.pid, devices.pid):
                        raise_priority(pid)
                    for _ in range(rounds):
                        for setting in SETTINGS:
                            found[setting] += await measure(gateway, setting)
                finally:
                    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
                    apply(SETTINGS[0], gateway.pid)  # the session outlives the daemon
    return found


def rows(quick: bool) -> list[Result]:
    """Return median and 99th percentile of the latency with every setting."""
    if (reason := MosquittoBroker.missing()) is not None or (reason := _missing_rights()):
        print(f"not run: {reason}", file=sys.stderr)
        return []
    found = asyncio.run(run(QUICK_ROUNDS if quick else ROUNDS))
    rows = []
    for setting, ms in found.items():
        note = f"{len(ms)} frames, longest {max(ms):.1f} ms"
        name = setting.name if not setting.busy else f"all cores in use, {setting.name}"
        rows += [
            timed_result(f"{name}: latency, median", round(percentile(ms, 0.5), 2), "ms"),
            timed_result(f"{name}: latency, p99", round(percentile(ms, 0.99), 2), "ms", note=note),
        ]
    return rows


def _missing_rights() -> str:
    """Return why this process cannot raise priorities; an empty text if it can."""
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY))
    except PermissionError:
        return "real-time priority needs root"
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    if not Path("/proc/self/autogroup").exists():
        return "this kernel has no priorities of sessions (autogroup)"
    return ""


EXPERIMENTS = (
    speed_experiment(
        "gateway-priorities",
        "Processes: 4 × 100 Hz while other programs use all cores, with priorities of the service",
        rows,
        in_short_run=False,
    ),
)
