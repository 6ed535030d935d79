"""LPMS: CPU time of codecs and decoders per message, compared with cantools on CAN.

No Python package reads LP-BUS, so its codec has no comparison. In the same run, cantools decodes
the same CAN frames with a table of their four signals.
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
from jointfit_protocols.can import pack_frames
from jointfit_protocols.lpms import LpBusCodec, encode
from jointfit_protocols.lpms.channels import ChannelIds, LpmsCanCodec, encode_frames, tpdo_ids
from jointfit_protocols.lpms.configuration import GENERATION_3
from jointfit_protocols.lpms.measurement import PacketLayout

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.framework.experiment import Result

N = 500
PERIOD_NS = 10_000_000
Q = (0.5, -0.5, 0.1, 0.7)
LAYOUT = PacketLayout(GENERATION_3, GENERATION_3.quaternion)
MESSAGES = [encode(0x09, LAYOUT.encode(5 * k, Q, floats=True)) for k in range(N)]
IDS = tpdo_ids(1)
FRAMES = [
    encode_frames(IDS, [10_000 * part for part in Q] + [0.0] * 12, "int16", k * PERIOD_NS)[0]
    for k in range(N)
]
TABLE = """VERSION ""
NS_ :
BS_:
BU_: LPMS HOST
BO_ 385 LPMS1_TPDO1: 8 LPMS
 SG_ QuatW : 0|16@1- (0.0001,0) [-1|1] "" HOST
 SG_ QuatX : 16|16@1- (0.0001,0) [-1|1] "" HOST
 SG_ QuatY : 32|16@1- (0.0001,0) [-1|1] "" HOST
 SG_ QuatZ : 48|16@1- (0.0001,0) [-1|1] "" HOST
"""


def _whole(name: str, chunks: list[Chunk], **table: object) -> Callable[[], Callable[[], object]]:
    """Return a function that prepares a decoder run; check that each chunk yields a sample."""
    driver = find_driver(name)
    settings = driver.Settings(id="S1", segment="thigh", driver=name, rate_hz=100, **table)
    decoder = driver(settings).decoder()
    given = [item for chunk in chunks for item in decoder.feed(chunk)]
    assert sum(isinstance(item, ImuSample) for item in given) == N

    def prepare() -> Callable[[], object]:
        fresh = driver(settings).decoder()
        return lambda: [fresh.feed(chunk) for chunk in chunks]

    return prepare


def _lpbus() -> Callable[[], object]:
    codec = LpBusCodec()
    return lambda: [codec.feed(data) for data in MESSAGES]


def _channels() -> Callable[[], object]:
    codec = LpmsCanCodec(ChannelIds(IDS, 0x701), "int16", (1, 2, 3, 4), PERIOD_NS // 2)
    return lambda: [codec.feed(frame) for frame in FRAMES]


def _peer() -> Callable[[], object]:
    table = cantools.database.load_string(TABLE, "dbc")
    assert isinstance(table, cantools.database.Database)
    return lambda: [table.decode_message(frame.can_id, frame.data) for frame in FRAMES]


def rows(quick: bool) -> list[Result]:
    serial = [Chunk(k * PERIOD_NS, data) for k, data in enumerate(MESSAGES)]
    frames = [Chunk(frame.t_ns, pack_frames([frame])) for frame in FRAMES]
    imu = _whole("lpms", serial, port="p", generation=3)
    on_can = _whole(
        "lpms-can",
        frames,
        can={"interface": "virtual", "channel": "bench"},
        mode="canopen",
        ids={f"frame{k}": number for k, number in enumerate(IDS, 1)},
        precision="int16",
    )

    ours: list[float] = []
    theirs: list[float] = []
    for _ in range(repeats(quick)):  # both libraries alternate
        for prepare, took in ((_channels, ours), (_peer, theirs)):
            work = prepare()
            gc.collect()
            took.append(cpu_s(work) / N)
    ratio = statistics.median(a / b for a, b in zip(ours, theirs, strict=True))
    peer_us = round(statistics.median(theirs) * 1e6, 2)

    return [
        per_item("lpms: codec, one message", _lpbus, items=N, goal_us=6, quick=quick),
        per_item("lpms: bytes to SI sample", imu, items=N, goal_us=25, quick=quick),
        per_item("lpms-can: codec, one CAN frame", _channels, items=N, goal_us=6, quick=quick),
        per_item("lpms-can: CAN frame to SI sample", on_can, items=N, goal_us=25, quick=quick),
        timed_result("lpms-can: cantools, one CAN frame", peer_us, "µs"),
        timed_result("lpms-can: time ratio to cantools", round(ratio, 4), "", 0.5, 1.0),
    ]


EXPERIMENTS = (
    replace(
        speed_experiment("lpms-codec", "LPMS: codecs and decoders, on CAN with a peer", rows),
        packages=("cantools",),
    ),
)
