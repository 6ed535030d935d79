"""Messages described by tables: CPU time of codecs and decoders, compared with cantools on CAN.

The CAN frame has four 16-bit integers. In the same run, cantools decodes the same frame from the
table of a DBC file.
"""

from __future__ import annotations

import gc
import statistics
from dataclasses import replace
from typing import TYPE_CHECKING

import cantools

from bench.framework.measurement import cpu_s, per_item, repeats, speed_experiment, timed_result
from jointfit_daemon.driver import find_driver
from jointfit_daemon.model import Chunk, ImuSample
from jointfit_protocols.can import CanFrame, pack_frames
from jointfit_protocols.table import (
    CanTable,
    CanTableCodec,
    Checksum,
    FrameCodec,
    FrameFormat,
    LineCodec,
    LineFormat,
    TableField,
    encode_can_frames,
    encode_frame,
    encode_line,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.framework.experiment import Result

N = 500
PERIOD_NS = 10_000_000
COUNTS = (16384, -16384, 3277, 22937)
TIME = 13
BINARY = FrameFormat(
    b"\xaa\x55",
    {slot: TableField(6 + 2 * slot, "i", 16) for slot in range(4)} | {TIME: TableField(2, "u", 32)},
    16,
    checksum=Checksum("fletcher16"),
)
LINES = LineFormat({slot: slot + 1 for slot in range(4)} | {TIME: 0}, width=5)
CAN = CanTable(((0x131, False),), {slot: TableField(2 * slot, "i", 16) for slot in range(4)})
FRAMES = [encode_frame(BINARY, [*COUNTS, 10_000 * k]) for k in range(N)]
TEXTS = [encode_line(LINES, [0.5, -0.5, 0.1, 0.7, 10_000 * k]) for k in range(N)]
CAN_FRAMES = [
    CanFrame(k * PERIOD_NS, 0x131, encode_can_frames(CAN, COUNTS)[0][1]) for k in range(N)
]
QUATERNION = {"type": "i16", "divisor": 32767}
TIME_KEYS = {"type": "u32", "unit": "us"}
TABLES: dict[str, tuple[str, dict[str, object]]] = {
    "binary": (
        "serial-table",
        {
            "port": "p",
            "frame": {"sync": "AA 55", "length": 16, "checksum": {"kind": "fletcher16"}},
            "fields": {
                "time": {"offset": 2, **TIME_KEYS},
                "quaternion": {"offset": 6, **QUATERNION},
            },
        },
    ),
    "lines": (
        "serial-table",
        {
            "port": "p",
            "text": {"columns": 5},
            "fields": {"time": {"column": 1, "unit": "us"}, "quaternion": {"column": 2}},
        },
    ),
    "can": (
        "can-table",
        {
            "can": {"interface": "virtual", "channel": "bench"},
            "ids": {"quaternion": 0x131},
            "fields": {"quaternion": {"offset": 0, **QUATERNION}},
        },
    ),
}
DBC = """VERSION ""
BU_: SBG HOST
BO_ 305 QUAT: 8 SBG
 SG_ Q0 : 0|16@1- (3.0518509475997192E-05,0) [-1|1] "" HOST
 SG_ Q1 : 16|16@1- (3.0518509475997192E-05,0) [-1|1] "" HOST
 SG_ Q2 : 32|16@1- (3.0518509475997192E-05,0) [-1|1] "" HOST
 SG_ Q3 : 48|16@1- (3.0518509475997192E-05,0) [-1|1] "" HOST
"""


def _whole(kind: str, messages: list[bytes]) -> Callable[[], Callable[[], object]]:
    """Return a function that prepares a decoder run; check that each chunk yields a sample."""
    name, table = TABLES[kind]
    driver = find_driver(name)
    head = {"id": "S1", "segment": "thigh", "driver": name, "rate_hz": 100}
    settings = driver.Settings.model_validate(head | table)
    chunks = [Chunk((1 + k) * PERIOD_NS, data) for k, data in enumerate(messages)]
    decoder = driver(settings).decoder()
    given = [item for chunk in chunks for item in decoder.feed(chunk)]
    assert sum(isinstance(item, ImuSample) for item in given) == N

    def prepare() -> Callable[[], object]:
        fresh = driver(settings).decoder()
        return lambda: [fresh.feed(chunk) for chunk in chunks]

    return prepare


def _binary() -> Callable[[], object]:
    codec = FrameCodec(BINARY)
    return lambda: [codec.feed(data) for data in FRAMES]


def _lines() -> Callable[[], object]:
    codec = LineCodec(LINES)
    return lambda: [codec.feed(data) for data in TEXTS]


def _can() -> Callable[[], object]:
    codec = CanTableCodec(CAN)
    return lambda: [codec.feed(frame) for frame in CAN_FRAMES]


def _peer() -> Callable[[], object]:
    table = cantools.database.load_string(DBC, "dbc")
    assert isinstance(table, cantools.database.Database)
    return lambda: [table.decode_message(frame.can_id, frame.data) for frame in CAN_FRAMES]


def rows(quick: bool) -> list[Result]:
    packed = [pack_frames([frame]) for frame in CAN_FRAMES]
    wholes = {"binary": FRAMES, "lines": TEXTS, "can": packed}
    prepared = {kind: _whole(kind, messages) for kind, messages in wholes.items()}

    ours: list[float] = []
    theirs: list[float] = []
    for _ in range(repeats(quick)):  # both libraries alternate
        for prepare, took in ((_can, ours), (_peer, theirs)):
            work = prepare()
            gc.collect()
            took.append(cpu_s(work) / N)
    ratio = statistics.median(a / b for a, b in zip(ours, theirs, strict=True))
    peer_us = round(statistics.median(theirs) * 1e6, 2)

    def measured(name: str, prepare: Callable[[], Callable[[], object]], goal_us: float) -> Result:
        return per_item(name, prepare, items=N, goal_us=goal_us, quick=quick)

    return [
        measured("serial-table: codec, one frame of 16 bytes", _binary, 6),
        measured("serial-table: frame to SI sample", prepared["binary"], 25),
        measured("serial-table: codec, one line of 5 columns", _lines, 6),
        measured("serial-table: line to SI sample", prepared["lines"], 25),
        measured("can-table: codec, one CAN frame", _can, 6),
        measured("can-table: CAN frame to SI sample", prepared["can"], 25),
        timed_result("can-table: cantools, one CAN frame", peer_us, "µs"),
        timed_result("can-table: time ratio to cantools", round(ratio, 4), "", 0.7, 1.0),
    ]


EXPERIMENTS = (
    replace(
        speed_experiment(
            "table-codec", "Self-described devices: codecs and decoders, on CAN with a peer", rows
        ),
        packages=("cantools",),
    ),
)
