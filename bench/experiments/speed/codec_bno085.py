"""BNO085: codecs and decoders per sample, compared with the package of Adafruit in the same run."""

from __future__ import annotations

import gc
import statistics
import sys
from dataclasses import replace
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from bench.framework.measurement import cpu_s, per_item, repeats, speed_experiment, timed_result
from jointfit_daemon.driver import find_driver
from jointfit_daemon.model import Chunk, ImuSample
from jointfit_protocols import bno085

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.framework.experiment import Result

N = 2000
PERIOD_NS = 10_000_000
FRAMES = [
    bno085.encode_rvc(bno085.RvcFrame(k & 0xFF, (k, -110, 2085), (-371, -20, 977)))
    for k in range(N)
]
PACKETS = [
    bno085.encode_shtp(
        bno085.ShtpChannel.INPUT,
        k,
        bno085.encode_base_time(12)
        + bno085.encode_report(
            bno085.HubReport(
                bno085.HubReportId.ROTATION_VECTOR, k & 0xFF, 3, 1, (0.0, 0.0, 0.6, 0.8, 0.05)
            )
        ),
    )
    for k in range(N)
]


def _whole(wires: list[bytes], baud: int) -> Callable[[], Callable[[], object]]:
    """Return a function that prepares a run of the decoder of a mode, one sample a chunk."""
    driver = find_driver("bno085")
    settings = driver.Settings(id="S1", segment="thigh", driver="bno085", port="p", baud=baud)
    start = b"" if baud == 115_200 else b"\x7e"
    chunks = [Chunk(k * PERIOD_NS, data) for k, data in enumerate([start, *wires])]
    decoder = driver(settings).decoder()
    given = [item for chunk in chunks for item in decoder.feed(chunk)]
    assert sum(isinstance(item, ImuSample) for item in given) == N

    def prepare() -> Callable[[], object]:
        fresh = driver(settings).decoder()
        return lambda: [fresh.feed(chunk) for chunk in chunks]

    return prepare


def _own_codec() -> Callable[[], object]:
    codec = bno085.RvcCodec()
    return lambda: [codec.feed(data) for data in FRAMES]


def _shtp_codec() -> Callable[[], object]:
    codec = bno085.ShtpCodec()
    return lambda: [codec.feed(data) for data in PACKETS]


class _Wire:
    """Bytes in place of the UART of the package."""

    def __init__(self) -> None:
        self._data, self._at = b"".join(FRAMES), 0

    def reset_input_buffer(self) -> None:
        """Keep the bytes: the package would wait for the next frame."""

    def read(self, size: int) -> bytes:
        self._at += size
        return self._data[self._at - size : self._at]


def _peer() -> Callable[[], object]:
    """Return the reading of the same frames by the package."""
    busio = ModuleType("busio")  # the hardware layer of the package
    vars(busio)["UART"] = object
    sys.modules.setdefault("busio", busio)
    package: Any = import_module("adafruit_bno08x_rvc")  # an oracle of the tests
    reader = package.BNO08x_RVC(_Wire())
    return lambda: [reader.heading for _ in range(N)]


def rows(quick: bool) -> list[Result]:
    rvc, shtp = _whole(FRAMES, 115_200), _whole(PACKETS, 3_000_000)
    ours: list[float] = []
    theirs: list[float] = []
    for _ in range(repeats(quick)):  # in turns
        for prepare, took in ((_own_codec, ours), (_peer, theirs)):
            work = prepare()
            gc.collect()
            took.append(cpu_s(work) / N)
    ratio = statistics.median(a / b for a, b in zip(ours, theirs, strict=True))
    peer_us = round(statistics.median(theirs) * 1e6, 2)
    return [
        per_item("bno085: RVC codec, one frame", _own_codec, items=N, goal_us=4, quick=quick),
        per_item("bno085: RVC bytes to SI sample", rvc, items=N, goal_us=15, quick=quick),
        per_item("bno085: SHTP codec, one packet", _shtp_codec, items=N, goal_us=5, quick=quick),
        per_item("bno085: SHTP bytes to SI sample", shtp, items=N, goal_us=20, quick=quick),
        timed_result("bno085: the package of Adafruit, one RVC frame", peer_us, "µs"),
        timed_result("bno085: RVC time ratio to the package", round(ratio, 4), "", 1.0, 1.2),
    ]


EXPERIMENTS = (
    replace(
        speed_experiment("bno085-codec", "BNO085: codecs and decoders, with a peer", rows),
        packages=("adafruit_bno08x_rvc",),
    ),
)
