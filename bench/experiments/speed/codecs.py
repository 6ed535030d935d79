"""Speed of the codecs and decoders of Xbus, SLCAN and XCDI, and of python-can and cantools.

All libraries are measured in the same run. No package on PyPI decodes Xbus messages. cantools
decodes the signals of single XCDI frames, but does not combine the frames of one sample.
"""

from __future__ import annotations

import fcntl
import gc
import os
import pty
import statistics
import struct
import termios
import time
import tty
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import can
import cantools

from bench.framework.measurement import cpu_s, per_item, repeats, speed_experiment, timed_result
from bench.subjects import device_bytes
from jointfit_daemon.driver import CanBusSettings, find_driver
from jointfit_daemon.model import Chunk, ImuSample
from jointfit_protocols import xbus, xcdi
from jointfit_protocols.can import slcan

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.framework.experiment import Result
    from jointfit_daemon.driver import Decoder
    from jointfit_protocols.can import CanFrame

N = 500
ORIENTATIONS = [(0.5, -0.5, 0.1, 0.7)] * N
PERIOD_NS = 2_500_000
IDS = xcdi.id_block(0x100)
SAMPLES = 33
BATCH = 3 * SAMPLES
"""Number of frames on the pseudo-terminal (pty) at once: 2 kB, much less than its buffer."""
TABLE = f"""VERSION ""
NS_ :
BS_:
BU_: MTI HOST
BO_ {IDS.sample_time} SampleTime: 4 MTI
 SG_ Ticks : 7|32@0+ (1,0) [0|0] "" HOST
BO_ {IDS.group_counter} GroupCounter: 2 MTI
 SG_ Counter : 7|16@0+ (1,0) [0|0] "" HOST
BO_ {IDS.quaternion} Quaternion: 8 MTI
 SG_ Q0 : 7|16@0- (1,0) [0|0] "" HOST
 SG_ Q1 : 23|16@0- (1,0) [0|0] "" HOST
 SG_ Q2 : 39|16@0- (1,0) [0|0] "" HOST
 SG_ Q3 : 55|16@0- (1,0) [0|0] "" HOST
"""


def _decoding(
    make: Callable[[], Decoder], chunks: list[Chunk]
) -> Callable[[], Callable[[], object]]:
    """Return a function that prepares a decoder run; check that each chunk yields a sample."""
    decoder = make()
    given = [item for chunk in chunks for item in decoder.feed(chunk)]
    assert sum(isinstance(item, ImuSample) for item in given) == len(chunks), given[:3]

    def prepare() -> Callable[[], object]:
        fresh = make()
        return lambda: [fresh.feed(chunk) for chunk in chunks]

    return prepare


def xbus_rows(quick: bool) -> list[Result]:
    messages = device_bytes.xbus_messages(ORIENTATIONS, PERIOD_NS)
    chunks = [Chunk(k * PERIOD_NS, data) for k, data in enumerate(messages)]
    driver = find_driver("xbus")
    settings = driver.Settings(id="S1", segment="thigh", driver="xbus", port="p", rate_hz=400)

    def codec() -> Callable[[], object]:
        decoder = xbus.XbusCodec()
        return lambda: [decoder.feed(data) for data in messages]

    whole = _decoding(lambda: driver(settings).decoder(), chunks)
    return [
        per_item("xbus: codec, one message", codec, items=N, goal_us=6, quick=quick),
        per_item("xbus: bytes to SI sample", whole, items=N, goal_us=25, quick=quick),
    ]


def xcdi_rows(quick: bool) -> list[Result]:
    groups = device_bytes.xcdi_frames(ORIENTATIONS, PERIOD_NS, IDS)
    lines = device_bytes.slcan_lines(groups)
    driver = find_driver("xcdi")
    names = ("sample_time", "group_counter", "quaternion")
    settings = driver.Settings(
        id="S3",
        segment="shank",
        driver="xcdi",
        can=CanBusSettings(interface="virtual", channel="bench"),
        ids={name: getattr(IDS, name) for name in names},
        rate_hz=400,
    )
    chunks = device_bytes.xcdi_chunks(ORIENTATIONS, PERIOD_NS, IDS)

    def codec() -> Callable[[], object]:
        decoder = slcan.SlcanCodec(3_000_000)
        return lambda: [decoder.feed(data, k * PERIOD_NS) for k, data in enumerate(lines)]

    whole = _decoding(lambda: driver(settings).decoder(), chunks)
    return [
        per_item("slcan: codec, one CAN frame", codec, items=3 * N, goal_us=12, quick=quick),
        per_item("xcdi: 3 CAN frames to SI sample", whole, items=N, goal_us=30, quick=quick),
    ]


def _frames() -> list[CanFrame]:
    groups = device_bytes.xcdi_frames(ORIENTATIONS, PERIOD_NS, IDS)
    return [frame for group in groups for frame in group]


def _groups() -> Callable[[], object]:
    codec = xcdi.XcdiCodec(IDS)
    frames = _frames()
    return lambda: [codec.feed(frame) for frame in frames]


def _table() -> Callable[[], object]:
    table = cantools.database.load_string(TABLE, "dbc")
    assert isinstance(table, cantools.database.Database)
    frames = _frames()
    values = table.decode_message(frames[2].can_id, frames[2].data)
    assert isinstance(values, dict)
    assert values["Q1"] == round(-0.5 * 32767)
    return lambda: [table.decode_message(frame.can_id, frame.data) for frame in frames]


def group_rows(quick: bool) -> list[Result]:
    """Decode the same frames with this project and with cantools, in turns."""
    ours: list[float] = []
    theirs: list[float] = []
    for _ in range(repeats(quick)):
        for prepare, took in ((_groups, ours), (_table, theirs)):
            work = prepare()
            gc.collect()
            took.append(cpu_s(work) / (3 * N))
    ratio = statistics.median(a / b for a, b in zip(ours, theirs, strict=True))
    return [
        *xcdi_rows(quick),
        timed_result("xcdi: codec, one CAN frame", _us(ours), "µs", 6, 24),
        timed_result("xcdi: cantools, one CAN frame", _us(theirs), "µs"),
        timed_result("xcdi: time ratio to cantools", round(ratio, 4), "", 0.5, 1.0),
    ]


# --- SLCAN of python-can, on the same pty with the same bytes -----------------------------------


class Line:
    """Pseudo-terminal (pty) that receives SLCAN frames at the other end."""

    def __init__(self) -> None:
        self._far, self.near = pty.openpty()
        tty.setraw(self.near)
        self.path = os.ttyname(self.near)
        groups = device_bytes.xcdi_frames(ORIENTATIONS[:SAMPLES], PERIOD_NS, IDS)
        self._bytes = b"".join(device_bytes.slcan_lines(groups))

    def send(self) -> None:
        """Write `BATCH` frames and wait until all of them can be read."""
        assert os.write(self._far, self._bytes) == len(self._bytes)
        until = time.monotonic() + 5.0
        while self._waiting() < len(self._bytes):
            assert time.monotonic() < until
            time.sleep(0.001)

    def _waiting(self) -> int:
        (count,) = struct.unpack("i", fcntl.ioctl(self.near, termios.FIONREAD, bytes(4)))
        return int(count)

    def close(self) -> None:
        os.close(self._far)
        os.close(self.near)


def _ours(line: Line) -> Callable[[], int]:
    decoder = slcan.SlcanCodec(115_200)

    def drain() -> int:
        return len(decoder.feed(os.read(line.near, 65536), 0))

    return drain


def _theirs(bus: Any) -> Callable[[], int]:
    def drain() -> int:
        return sum(bus.recv(0) is not None for _ in range(BATCH))

    return drain


def rival_rows(quick: bool) -> list[Result]:
    """Read the same frames from the same pseudo-terminal with both libraries, in turns."""
    line = Line()
    bus: Any = can.Bus(interface="slcan", channel=line.path, sleep_after_open=0)
    ours: list[float] = []
    theirs: list[float] = []
    ratios: list[float] = []
    try:
        drains = (_ours(line), ours), (_theirs(bus), theirs)
        for _ in range(repeats(quick)):
            for drain, took in drains:
                line.send()
                began = time.thread_time()
                got = drain()
                took.append((time.thread_time() - began) / BATCH)
                assert got == BATCH, got
            ratios.append(ours[-1] / theirs[-1])
    finally:
        bus.shutdown()
        line.close()
    return [
        timed_result("slcan: jointfit, one frame from a pty", _us(ours), "µs", 12, 48),
        timed_result("slcan: python-can, one frame from a pty", _us(theirs), "µs"),
        timed_result(
            "slcan: time ratio of jointfit to python-can",
            round(statistics.median(ratios), 4),
            "",
            0.2,
            0.5,
        ),
    ]


def _us(times: list[float]) -> float:
    return round(statistics.median(times) * 1e6, 2)


EXPERIMENTS = (
    speed_experiment(
        "xbus-codec",
        "Xbus: codec and decoder",
        xbus_rows,
    ),
    replace(
        speed_experiment("can-codec", "CAN: SLCAN and XCDI codecs, with a peer", group_rows),
        packages=("cantools",),
    ),
    speed_experiment(
        "slcan-python-can",
        "SLCAN on a pty, compared with python-can",
        rival_rows,
    ),
)
