"""Codecs and decoders, per message and per sample; SLCAN of python-can in the same run."""

from __future__ import annotations

import fcntl
import os
import pty
import statistics
import struct
import termios
import time
import tty
from typing import TYPE_CHECKING, Any

import can

from bench.framework.measurement import per_item, repeats, speed_experiment, timed_result
from bench.subjects import device_bytes
from jointfit_daemon.driver import CanBusSettings, find_driver
from jointfit_daemon.model import Chunk, ImuSample, MocapFrame
from jointfit_protocols import natnet, xbus, xcdi
from jointfit_protocols.can import slcan
from jointfit_simulators.body import CLUSTERS

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.framework.experiment import Result
    from jointfit_daemon.driver import Decoder

N = 500
ORIENTATIONS = [(0.5, -0.5, 0.1, 0.7)] * N
PERIOD_NS = 2_500_000
IDS = xcdi.id_block(0x100)
SAMPLES = 33
BATCH = 3 * SAMPLES
"""Frames on the pty at once: 2 kB, well below the buffer of a tty."""


def _decoding(
    make: Callable[[], Decoder], chunks: list[Chunk], kind: type, opening: tuple[Chunk, ...] = ()
) -> Callable[[], Callable[[], object]]:
    """Return a function that prepares a run of a decoder; check that each chunk gives a sample."""
    decoder = make()
    given = [item for chunk in (*opening, *chunks) for item in decoder.feed(chunk)]
    assert sum(isinstance(item, kind) for item in given) == len(chunks), given[:3]

    def prepare() -> Callable[[], object]:
        fresh = make()
        for chunk in opening:
            fresh.feed(chunk)
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

    whole = _decoding(lambda: driver(settings).decoder(), chunks, ImuSample)
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

    whole = _decoding(lambda: driver(settings).decoder(), chunks, ImuSample)
    return [
        per_item("slcan: codec, one CAN frame", codec, items=3 * N, goal_us=12, quick=quick),
        per_item("xcdi: 3 CAN frames to SI sample", whole, items=N, goal_us=30, quick=quick),
    ]


def natnet_rows(quick: bool) -> list[Result]:
    datagrams = device_bytes.natnet_datagrams(N, 8_333_333)
    driver = find_driver("natnet")
    settings = driver.Settings(
        driver="natnet",
        server="127.0.0.1",
        up_axis="y",
        markers={part: names for part, names in CLUSTERS.items() if part != "plate"},
        plate="Plate",
    )

    def codec() -> Callable[[], object]:
        return lambda: [natnet.decode_frame(data, device_bytes.BITSTREAM) for data in datagrams]

    whole_frame = natnet.decode_frame(datagrams[0], device_bytes.BITSTREAM)
    assert isinstance(whole_frame, natnet.FrameOfData), whole_frame

    opening = tuple(Chunk(0, data) for data in device_bytes.natnet_opening())
    chunks = [Chunk(k * 8_333_333, data) for k, data in enumerate(datagrams, 1)]
    whole = _decoding(lambda: driver(settings).decoder(), chunks, MocapFrame, opening)
    size = f"{len(CLUSTERS)} bodies, {sum(map(len, CLUSTERS.values()))} markers"
    return [
        per_item("natnet: codec, one frame", codec, items=N, goal_us=60, quick=quick, note=size),
        per_item("natnet: bytes to MocapFrame", whole, items=N, goal_us=150, quick=quick),
    ]


# --- SLCAN of python-can, on the same pty with the same bytes -----------------------------------


class Line:
    """Pty with SLCAN frames at the other end."""

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
    """Read the same frames from the same pty with both libraries, in turns."""
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
    speed_experiment(
        "can-codec",
        "CAN: SLCAN codec and XCDI decoder",
        xcdi_rows,
    ),
    speed_experiment(
        "natnet-codec",
        "NatNet: codec and decoder",
        natnet_rows,
    ),
    speed_experiment(
        "slcan-python-can",
        "SLCAN on a pty, compared with python-can",
        rival_rows,
    ),
)
