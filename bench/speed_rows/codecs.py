"""Codec and driver-decoder times, on bytes made by our own encoders."""

from __future__ import annotations

from collections.abc import Callable

from bench.harness import Row, per_item
from jointfit_daemon.driver import CanBusSettings, find_driver
from jointfit_daemon.model import Chunk
from jointfit_protocols import mtdata2, slcan, xbus, xcdi
from jointfit_protocols.can_frame import CanFrame, pack_frames

N = 500
Q = (0.5, -0.5, 0.1, 0.7)
PERIOD_NS = 2_500_000


def xbus_messages() -> list[bytes]:
    """Counter, time, status and quaternion: what a configured MTi sends."""
    quaternion = mtdata2.real_id(mtdata2.Item.QUATERNION)
    return [
        xbus.encode(
            xbus.MessageId.MT_DATA2,
            mtdata2.encode_items(
                [
                    (mtdata2.Item.PACKET_COUNTER, k & 0xFFFF),
                    (mtdata2.Item.SAMPLE_TIME_FINE, 25 * k),
                    (mtdata2.Item.STATUS_WORD, 2),
                    (quaternion, Q),
                ]
            ),
        )
        for k in range(N)
    ]


def xcdi_frames(ids: xcdi.XcdiIds) -> list[CanFrame]:
    """Three frames a sample."""
    frames = []
    for k in range(N):
        t_ns = k * PERIOD_NS
        for can_id, data in (
            (ids.sample_time, xcdi.encode(xcdi.DataId.SAMPLE_TIME, (25 * k,))),
            (ids.group_counter, xcdi.encode(xcdi.DataId.GROUP_COUNTER, (k & 0xFFFF,))),
            (
                ids.quaternion,
                xcdi.encode(xcdi.DataId.QUATERNION, xcdi.quaternion_counts(Q)),
            ),
        ):
            frames.append(CanFrame(t_ns, can_id, data))
    return frames


def rows() -> list[Row]:
    """Return the rows of this file."""
    return [*_xbus_rows(), *_can_rows()]


def _xbus_rows() -> list[Row]:
    messages = xbus_messages()
    chunks = [Chunk(k * PERIOD_NS, data) for k, data in enumerate(messages)]
    driver = find_driver("xbus")
    settings = driver.Settings(id="S1", segment="thigh", driver="xbus", port="p", rate_hz=400)

    def codec() -> Callable[[], object]:
        decoder = xbus.XbusDecoder()
        return lambda: [decoder.feed(data) for data in messages]

    def whole() -> Callable[[], object]:
        decoder = driver(settings).decoder()
        return lambda: [decoder.feed(chunk) for chunk in chunks]

    return [
        per_item("xbus codec, one message", codec, items=N, goal_us=6),
        per_item("xbus decoder, one sample, bytes to SI", whole, items=N, goal_us=25),
    ]


def _can_rows() -> list[Row]:
    ids = xcdi.id_block(0x100)
    frames = xcdi_frames(ids)
    wire = [
        b"".join(slcan.encode_frame(frame) for frame in frames[3 * k : 3 * k + 3])
        for k in range(N)
    ]
    driver = find_driver("xcdi")
    settings = driver.Settings(
        id="S3",
        segment="shank",
        driver="xcdi",
        can=CanBusSettings(interface="virtual", channel="bench"),
        ids={
            "sample_time": ids.sample_time,
            "group_counter": ids.group_counter,
            "quaternion": ids.quaternion,
        },
        rate_hz=400,
    )
    chunks = [
        Chunk(k * PERIOD_NS, pack_frames(frames[3 * k : 3 * k + 3])) for k in range(N)
    ]

    def lines() -> Callable[[], object]:
        decoder = slcan.SlcanDecoder(3_000_000)
        return lambda: [decoder.feed(data, k * PERIOD_NS) for k, data in enumerate(wire)]

    def whole() -> Callable[[], object]:
        decoder = driver(settings).decoder()
        return lambda: [decoder.feed(chunk) for chunk in chunks]

    return [
        per_item(
            "slcan codec, one CAN frame",
            lines,
            items=3 * N,
            goal_us=12,
            note="python-can's takes 240-300 µs",
        ),
        per_item("xcdi decoder, one sample of 3 frames", whole, items=N, goal_us=30),
    ]
