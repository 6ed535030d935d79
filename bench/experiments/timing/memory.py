"""Memory of the core, which does not grow from the first to the tenth simulated hour.

The complete core processes four IMUs on UART and CAN, and cameras. Once per second, an echo (a
request and its answer with the server's time) measures the clock of the camera server. In every
hour, one sensor reboots and the next sensor of the list is silent for a minute. From
one hour to the next, each of these two faults moves on to the next sensor of the list. All devices
run at 5 Hz, so ten hours have 900 000 samples instead of 19 million.
Buffers with a time limit (windows, histograms, echoes) fill in the same time as at full rates.
Buffers with a limited number of entries are full within minutes.
"""

from __future__ import annotations

import gc
import sys
from dataclasses import dataclass
from itertools import count
from math import cos, sin
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.framework.experiment import Experiment, Result
from bench.framework.material import SIMULATED_CLOCKS
from bench.subjects.simulated_clocks import ON_UART, SERVER_HZ, VERSION, xbus_chunk, xcdi_chunk
from bench.subjects.simulated_wearer import bench_rig
from jointfit_daemon.config import parse_rig
from jointfit_daemon.model import Chunk, LimbState
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import ChunkArrived, Configured, SourceOpened
from jointfit_protocols.natnet import (
    EchoRequest,
    EchoResponse,
    FrameOfData,
    ModelDefinition,
    ServerInfo,
    encode,
)
from jointfit_simulators.body import SENSORS
from jointfit_simulators.devices import SimulatedClock

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from jointfit_daemon.config import Rig

NS, MS = 1_000_000_000, 1_000_000
RATE_HZ = 5.0
PERIOD_NS = round(NS / RATE_HZ)
BEGIN_NS = 1_000 * NS
MINUTE_NS = 60 * NS
REBOOT, SILENCE = 20, 40
"""Minutes of each hour in which a sensor reboots and in which a sensor is silent."""
SETTLE_H = 0.5
"""Time after which windows and histograms are full, h."""
_SHARED = (type, ModuleType, FunctionType, BuiltinFunctionType, MethodType)
_SKEW = {"S1": -40e-6, "S2": -10e-6, "S3": 20e-6, "S4": 50e-6, "mocap": 30e-6}


@dataclass(frozen=True, slots=True)
class Held:
    """Objects that a core references at one time."""

    hours: float
    size: int
    """Size of all objects except code, bytes."""
    objects: int


def rig() -> Rig:
    """Return a rig of four sensors and cameras, all at 5 Hz."""
    table = bench_rig().table
    imus = [{**imu, "rate_hz": RATE_HZ} for imu in table["imu"]]
    return parse_rig({**table, "imu": imus, "rig": {**table["rig"], "output_rate_hz": RATE_HZ}})


def held(root: object, hours: float) -> Held:
    """Return the number and size of the objects that `root` references."""
    seen: set[int] = set()
    todo: list[Any] = [root]
    size = 0
    while todo:
        item = todo.pop()
        if id(item) in seen or isinstance(item, _SHARED):
            continue
        seen.add(id(item))
        size += sys.getsizeof(item)
        todo += gc.get_referents(item)
    return Held(hours, size, len(seen))


class Hardware:
    """Endless byte streams of five devices."""

    def __init__(self) -> None:
        self._clocks = {
            name: SimulatedClock(BEGIN_NS - 100 * NS, skew) for name, skew in _SKEW.items()
        }
        self._numbers = dict.fromkeys(_SKEW, 0)
        self._dice = np.random.default_rng(11)

    def minutes(self) -> Iterator[list[ChunkArrived]]:
        """Yield the events of each successive minute."""
        for minute in count():
            begin_ns = BEGIN_NS + minute * MINUTE_NS
            hour, of_hour = divmod(minute, 60)
            names = list(SENSORS)
            if of_hour == REBOOT:
                self._reboot(names[hour % len(names)], begin_ns)
            silent = names[(hour + 1) % len(names)] if of_hour == SILENCE else ""
            chunks = self._cameras(begin_ns)
            for name in names:
                if name != silent:
                    chunks += self._sensor(name, begin_ns)
            chunks.sort()
            yield [ChunkArrived(name, Chunk(t_ns, data)) for t_ns, name, data in chunks]

    def _reboot(self, name: str, at_ns: int) -> None:
        self._clocks[name] = SimulatedClock(at_ns - NS, _SKEW[name])
        self._numbers[name] = 0

    def _taken(self, name: str, begin_ns: int) -> list[tuple[int, int, int]]:
        """Return number, device time and arrival time of the samples of a minute."""
        clock, found = self._clocks[name], []
        late = self._dice.exponential(0.5 * MS, round(60 * RATE_HZ)).tolist()
        for k, late_ns in enumerate(late):
            at_ns = begin_ns + k * PERIOD_NS + 3 * MS * len(name)
            found.append((self._numbers[name], clock.device_ns(at_ns), at_ns + round(late_ns)))
            self._numbers[name] += 1
        return found

    def _sensor(self, name: str, begin_ns: int) -> list[tuple[int, str, bytes]]:
        write = xbus_chunk if name in ON_UART else xcdi_chunk
        found = []
        for number, device_ns, due_ns in self._taken(name, begin_ns):
            half = 0.4 * sin(0.3 * number)
            q = (cos(half), sin(half), 0.0, 0.0)
            t_ns, data = write(name, number, device_ns // 100_000, due_ns, q)
            found.append((t_ns, name, data))
        return found

    def _cameras(self, begin_ns: int) -> list[tuple[int, str, bytes]]:
        words: list[tuple[int, Any]] = []
        if begin_ns == BEGIN_NS:
            info = ServerInfo("Motive", (2, 3, 0, 0), (*VERSION, 0, 0), SERVER_HZ)
            words += [(begin_ns, info), (begin_ns, ModelDefinition(()))]
        for number, device_ns, due_ns in self._taken("mocap", begin_ns):
            ticks = device_ns * SERVER_HZ // NS
            words.append((due_ns, FrameOfData(number, 0.0, ticks, ticks + 1, ticks + 2)))
        for second in range(60):
            stamp, asked_ns = second + 1, begin_ns + second * NS + NS // 3
            ticks = self._clocks["mocap"].device_ns(asked_ns + MS // 2) * SERVER_HZ // NS
            words.append((asked_ns, EchoRequest(stamp)))
            words.append((asked_ns + MS, EchoResponse(stamp, ticks)))
        return [(t_ns, "mocap", encode(word, VERSION)) for t_ns, word in words]


def watch(hours: float, looks_an_hour: int) -> tuple[list[Held], int, int]:
    """Run a core for some hours; return its memory over time, and numbers of chunks and states."""
    core = Core()
    made = rig()
    core.feed(Configured(BEGIN_NS, made, None))
    for source in made.sources:
        core.feed(SourceOpened(BEGIN_NS, source.id))
    looks: list[Held] = []
    states = samples = 0
    every = 60 // looks_an_hour
    for minute, events in enumerate(Hardware().minutes(), 1):
        samples += len(events)
        for event in events:
            states += sum(isinstance(output, LimbState) for output in core.feed(event))
        if minute % every == 0:
            core.health(events[-1].chunk.t_ns)  # the daemon also computes the health regularly
            looks.append(held(core, minute / 60))
        if minute >= 60 * hours:
            return looks, samples, states
    raise AssertionError  # the simulated devices have no end


def growth(looks: list[Held]) -> float:
    """Return the memory growth of a core after settling, bytes per hour (least squares)."""
    settled = [look for look in looks if look.hours > SETTLE_H]
    hours = [look.hours for look in settled]
    return float(np.polyfit(hours, [look.size for look in settled], 1)[0])


def flat(_data: Path) -> list[Result]:
    """Measure the memory over ten hours, four times an hour."""
    looks, samples, states = watch(10.0, 4)
    sizes = [look.size for look in looks if look.hours > SETTLE_H]
    return [
        Result("samples and echoes fed", samples / 1e3, float("inf"), unit="thousand"),
        Result("limb states", states / 1e3, float("inf"), minimum=150.0, unit="thousand"),
        Result("memory after the first hour", looks[3].size / 1024, float("inf"), unit="KiB"),
        Result("memory after the tenth hour", looks[-1].size / 1024, float("inf"), unit="KiB"),
        Result("largest minus smallest", (max(sizes) - min(sizes)) / 1024, 32.0, unit="KiB"),
        Result("growth", growth(looks) / 1024, 0.5, unit="KiB an hour"),
    ]


EXPERIMENTS: tuple[Experiment, ...] = (
    Experiment(
        "core-memory-ten-hours",
        "Memory of the core over ten simulated hours",
        flat,
        SIMULATED_CLOCKS,
        long=True,
    ),
)
