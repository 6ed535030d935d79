"""x-IMU3: CPU time of codec and decoder per message, compared with the vendor's package."""

from __future__ import annotations

import gc
import math
import statistics
import tempfile
import time
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.framework.measurement import per_item, repeats, speed_experiment, timed_result
from jointfit_daemon.driver import find_driver
from jointfit_daemon.model import Chunk, ImuSample
from jointfit_protocols import ximu3

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.framework.experiment import Result

N = 500
PERIOD_US = 2_500
MESSAGES = [
    ximu3.encode_data(
        "Q",
        1_000_000 + k * PERIOD_US,
        (math.cos(0.003 * k), 0.6 * math.sin(0.003 * k), 0.0, 0.8 * math.sin(0.003 * k)),
    )
    for k in range(N)
]
"""Messages for the measurement. One of twelve messages contains an escape sequence."""
TURNS = 20
"""Number of repetitions of the messages in the file for the comparison."""
BLOCK = 4096
"""Number of bytes per read."""
_LONGEST_S = 20.0


def _own_codec() -> Callable[[], object]:
    codec = ximu3.XImu3Codec()
    return lambda: [codec.feed(data) for data in MESSAGES]


def own_rows(quick: bool) -> list[Result]:
    """Measure the codec and the whole decoder with one message per chunk."""
    driver = find_driver("ximu3")
    settings = driver.Settings(id="S1", segment="thigh", driver="ximu3", port="p", rate_hz=400)
    chunks = [Chunk(k * PERIOD_US * 1000, data) for k, data in enumerate(MESSAGES)]
    decoder = driver(settings).decoder()
    given = [item for chunk in chunks for item in decoder.feed(chunk)]
    assert sum(isinstance(item, ImuSample) for item in given) == N

    def whole() -> Callable[[], object]:
        fresh = driver(settings).decoder()
        return lambda: [fresh.feed(chunk) for chunk in chunks]

    return [
        per_item("ximu3: codec, one message", _own_codec, items=N, goal_us=4, quick=quick),
        per_item("ximu3: bytes to SI sample", whole, items=N, goal_us=20, quick=quick),
    ]


def _ours_s(file: Path) -> float:
    """Return our CPU time to convert a message of a file to a time stamp and four numbers, s."""
    codec = ximu3.XImu3Codec()
    read: list[object] = []  # messages with Python numbers as values
    began = time.process_time()
    with file.open("rb") as stream:
        while block := stream.read(BLOCK):
            read += codec.feed(block)
    took = time.process_time() - began
    assert len(read) == TURNS * N
    return took / (TURNS * N)


def _theirs_s(file: Path, *, live: bool) -> float:
    """Return the package's CPU time per message, s; the package reads the file in a thread.

    The package calls a function for each message. With `live`, this function reads the message in
    Python, as a live program does. Otherwise it is `list.append`, the fastest function, and the
    messages are read together at the end.
    """
    package = import_module("ximu3")  # tests use this package as a reference
    received: list[Any] = []
    read: list[tuple[float, ...]] = []

    def use(message: Any) -> None:
        read.append((message.timestamp, message.w, message.x, message.y, message.z))

    connection = package.Connection(package.FileConnectionConfig(str(file)))
    connection.add_quaternion_callback(use if live else received.append)
    began, until = time.process_time(), time.monotonic() + _LONGEST_S
    connection.open()
    while len(received) + len(read) < TURNS * N and time.monotonic() < until:
        time.sleep(0.005)
    for message in received:
        use(message)
    took = time.process_time() - began
    connection.close()
    assert len(read) == TURNS * N
    return took / (TURNS * N)


def rows(quick: bool) -> list[Result]:
    ours: list[float] = []
    stored: list[float] = []
    live: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "messages.ximu3"
        file.write_bytes(TURNS * b"".join(MESSAGES))
        for _ in range(repeats(quick)):  # both libraries alternate
            for took, measure in (
                (ours, _ours_s),
                (stored, partial(_theirs_s, live=False)),
                (live, partial(_theirs_s, live=True)),
            ):
                gc.collect()
                took.append(measure(file))

    ratios = {
        use: round(statistics.median(a / b for a, b in zip(ours, other, strict=True)), 3)
        for use, other in (("live", live), ("of a file", stored))
    }
    return [
        *own_rows(quick),
        timed_result("ximu3: codec, one message of a file", _us(ours), "µs"),
        timed_result("ximu3: the package ximu3, one message of a file", _us(stored), "µs"),
        timed_result("ximu3: the package ximu3, one message live", _us(live), "µs"),
        timed_result("ximu3: time ratio to the package, live", ratios["live"], "", 0.5, 1),
        timed_result("ximu3: time ratio to the package, file", ratios["of a file"], "", 1, 2),
    ]


def _us(times: list[float]) -> float:
    return round(statistics.median(times) * 1e6, 2)


EXPERIMENTS = (
    replace(
        speed_experiment("ximu3-codec", "x-IMU3: codec and decoder, with the vendor's", rows),
        packages=("ximu3",),
    ),
)
