"""BNO085: CPU time of codecs and decoders per sample, compared with Adafruit's packages."""

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
    """Return a function that prepares a run of one mode's decoder, with one sample per chunk."""
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
    """Bytes that replace the UART of a package."""

    def __init__(self, messages: list[bytes]) -> None:
        self._data, self._at = b"".join(messages), 0

    def reset_input_buffer(self) -> None:
        """Do nothing; otherwise, the package would wait for the next frame."""

    def read(self, size: int) -> bytes:
        self._at += size
        return self._data[self._at - size : self._at]


def _package(name: str) -> Any:
    """Return a package of Adafruit without the hardware layer that it imports."""
    busio, micropython = ModuleType("busio"), ModuleType("micropython")
    vars(busio)["UART"], vars(micropython)["const"] = object, int
    sys.modules.setdefault("busio", busio)
    sys.modules.setdefault("micropython", micropython)
    return import_module(name)


def _rvc_peer() -> Callable[[], object]:
    """Return a function that reads the same frames with the package."""
    reader = _package("adafruit_bno08x_rvc").BNO08x_RVC(_Wire(FRAMES))
    return lambda: [reader.heading for _ in range(N)]


def _shtp_peer() -> Callable[[], object]:
    """Return a function that reads the same packets with the package; no sensor is initialized."""
    base: Any = _package("adafruit_bno08x.uart").BNO08X_UART
    reader = type("Reader", (base,), {"initialize": lambda _: None})(_Wire(PACKETS))

    def read() -> None:
        for _ in range(N):
            reader._handle_packet(reader._read_packet())  # noqa: SLF001 - no public function
        (found,) = reader._readings.values()  # noqa: SLF001 - no public access
        assert [round(part, 3) for part in found] == [0.0, 0.0, 0.6, 0.8]

    return read


def _in_turns(
    own: Callable[[], Callable[[], object]], peer: Callable[[], Callable[[], object]], quick: bool
) -> tuple[float, float]:
    """Return the package's CPU time per message, us, and the ratio of our time to that time."""
    ours: list[float] = []
    theirs: list[float] = []
    for _ in range(repeats(quick)):
        for prepare, took in ((own, ours), (peer, theirs)):
            work = prepare()
            gc.collect()
            took.append(cpu_s(work) / N)
    ratio = statistics.median(a / b for a, b in zip(ours, theirs, strict=True))
    return round(statistics.median(theirs) * 1e6, 2), round(ratio, 4)


def rows(quick: bool) -> list[Result]:
    rvc, shtp = _whole(FRAMES, 115_200), _whole(PACKETS, 3_000_000)
    rvc_us, rvc_ratio = _in_turns(_own_codec, _rvc_peer, quick)
    shtp_us, shtp_ratio = _in_turns(_shtp_codec, _shtp_peer, quick)
    return [
        per_item("bno085: RVC codec, one frame", _own_codec, items=N, goal_us=4, quick=quick),
        per_item("bno085: RVC bytes to SI sample", rvc, items=N, goal_us=15, quick=quick),
        per_item("bno085: SHTP codec, one packet", _shtp_codec, items=N, goal_us=5, quick=quick),
        per_item("bno085: SHTP bytes to SI sample", shtp, items=N, goal_us=20, quick=quick),
        timed_result("bno085: the package of Adafruit, one RVC frame", rvc_us, "µs"),
        timed_result("bno085: RVC time ratio to the package", rvc_ratio, "", 1.0, 1.2),
        timed_result("bno085: the package of Adafruit, one SHTP packet", shtp_us, "µs"),
        timed_result("bno085: SHTP time ratio to the package", shtp_ratio, "", 0.5, 1.0),
    ]


EXPERIMENTS = (
    replace(
        speed_experiment("bno085-codec", "BNO085: codecs and decoders, with peers", rows),
        packages=("adafruit_bno08x_rvc", "adafruit_bno08x"),
    ),
)
