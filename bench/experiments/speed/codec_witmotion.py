"""WitMotion: CPU time of codec and decoder per frame, compared with the package `witmotion`."""

from __future__ import annotations

import gc
import statistics
from dataclasses import replace
from importlib import import_module
from typing import TYPE_CHECKING, Any

from bench.framework.measurement import cpu_s, per_item, repeats, speed_experiment, timed_result
from jointfit_daemon.driver import find_driver
from jointfit_daemon.model import Chunk, ImuSample
from jointfit_protocols import witmotion

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.framework.experiment import Result

N = 500
PERIOD_NS = 5_000_000
FRAMES = [
    witmotion.encode(
        witmotion.WitMotionFrameKind.QUATERNION,
        witmotion.encode_counts((16_384, -16_384, 3_277, 22_938 + k % 7)),
    )
    for k in range(N)
]


def _own_codec() -> Callable[[], object]:
    codec = witmotion.WitMotionCodec()
    return lambda: [codec.feed(data) for data in FRAMES]


def own_rows(quick: bool) -> list[Result]:
    """Measure the codec and the whole decoder with one frame per chunk."""
    driver = find_driver("witmotion")
    settings = driver.Settings(id="S1", segment="thigh", driver="witmotion", port="p", rate_hz=200)
    chunks = [Chunk(k * PERIOD_NS, data) for k, data in enumerate(FRAMES)]
    decoder = driver(settings).decoder()
    given = [item for chunk in chunks for item in decoder.feed(chunk)]
    assert sum(isinstance(item, ImuSample) for item in given) == N

    def whole() -> Callable[[], object]:
        fresh = driver(settings).decoder()
        return lambda: [fresh.feed(chunk) for chunk in chunks]

    return [
        per_item("witmotion: codec, one frame", _own_codec, items=N, goal_us=4, quick=quick),
        per_item("witmotion: bytes to SI sample", whole, items=N, goal_us=15, quick=quick),
    ]


class _Wire:
    """Bytes that replace the serial port of the package; its reader stops at their end."""

    def __init__(self, imu: Any) -> None:
        self._data, self._at, self._imu = b"".join(FRAMES), 0, imu

    def read(self, size: int = 1) -> bytes:
        data = self._data[self._at : self._at + size]
        self._at += size
        self._imu.should_exit = self._at >= len(self._data)
        return data


def _peer() -> Callable[[], object]:
    """Return the receive loop of the package on the same bytes, without its thread."""
    package = import_module("witmotion")  # tests use this package as a reference
    imu = package.IMU.__new__(package.IMU)
    imu.should_exit = False
    received: list[object] = []
    imu._handle_message = received.append  # noqa: SLF001 - no public output
    imu.ser = _Wire(imu)

    def read() -> None:
        imu._rxloop()  # noqa: SLF001 - the loop of its thread
        assert len(received) == N

    return read


def rows(quick: bool) -> list[Result]:
    ours: list[float] = []
    theirs: list[float] = []
    for _ in range(repeats(quick)):  # both libraries alternate
        for prepare, took in ((_own_codec, ours), (_peer, theirs)):
            work = prepare()
            gc.collect()
            took.append(cpu_s(work) / N)
    ratio = statistics.median(a / b for a, b in zip(ours, theirs, strict=True))
    peer_us = round(statistics.median(theirs) * 1e6, 2)
    return [
        *own_rows(quick),
        timed_result("witmotion: the package witmotion, one frame", peer_us, "µs"),
        timed_result("witmotion: time ratio to the package", round(ratio, 4), "", 0.5, 1.0),
    ]


EXPERIMENTS = (
    replace(
        speed_experiment("witmotion-codec", "WitMotion: codec and decoder, with a peer", rows),
        packages=("witmotion",),
    ),
)
