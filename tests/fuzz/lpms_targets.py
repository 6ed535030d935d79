"""Fuzz targets of LPMS: serial bytes, records in valid messages, and frames on CAN."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

from jointfit_daemon.driver import find_driver
from jointfit_daemon.model import Chunk
from jointfit_protocols.can import CanFrame, pack_frames
from jointfit_protocols.lpms import LpBusCodec, LpBusMessage, encode
from jointfit_protocols.lpms.channels import HEARTBEAT, encode_frames, tpdo_ids
from jointfit_protocols.lpms.configuration import GENERATION_1, LpmsConfiguration
from jointfit_protocols.lpms.configuration import encode_configuration as encode_reply
from jointfit_protocols.lpms.measurement import PacketLayout
from tests.fuzz.target import Target, UnaccountedError
from tests.fuzz.wire_targets import cut, records

if TYPE_CHECKING:
    from jointfit_daemon.driver import Decoder

_PERIOD_NS = 10_000_000
_IDS = tpdo_ids(1)
_IMU = {"id": "S1", "segment": "thigh"}
_CAN = {
    "can": {"interface": "virtual", "channel": "fuzz"},
    "mode": "canopen",
    "ids": {f"frame{k}": number for k, number in enumerate(_IDS, 1)},
}


@cache
def _settings(name: str, **table: Any) -> tuple[Any, Any]:
    driver = find_driver(name)
    more = {"port": "file", "generation": 1} if name == "lpms" else _CAN
    return driver, driver.Settings.model_validate({"driver": name, **_IMU, **more, **table})


def _decoder(name: str, **table: Any) -> Decoder:
    driver, settings = _settings(name, **table)
    decoder: Decoder = driver(settings).decoder()
    return decoder


def run_lpbus_bytes(data: bytes) -> None:
    """Decode serial bytes in pieces; every byte belongs to a message or is counted."""
    codec, found = LpBusCodec(), []
    for piece in cut(data):
        found += codec.feed(piece)
    found += codec.flush()
    used = sum(item.size if isinstance(item, LpBusMessage) else item.discarded for item in found)
    if used != len(data):
        raise UnaccountedError(f"{len(data)} bytes, {used} in messages or discarded")


def run_lpms_decoder(data: bytes) -> None:
    """Put records ``command, content`` into valid messages and decode them."""
    decoder = _decoder("lpms")
    for number, (command, content) in enumerate(records(data)):
        decoder.feed(Chunk(number * _PERIOD_NS, encode(command, content)))
    decoder.flush()


def run_lpms_can(data: bytes) -> None:
    """Put records into the frames of a sensor and decode them in both precisions."""
    ids = (*_IDS, HEARTBEAT + 1)
    for precision in ("int16", "float32"):
        decoder = _decoder("lpms-can", precision=precision)
        for number, (kind, content) in enumerate(records(data)):
            frame = CanFrame(number * _PERIOD_NS // 4, ids[kind % len(ids)], content[:8])
            decoder.feed(Chunk(frame.t_ns, pack_frames([frame])))
        decoder.flush()


def _packet(tick: int) -> bytes:
    layout = PacketLayout(GENERATION_1, GENERATION_1.quaternion)
    return layout.encode(tick, (0.5, -0.5, 0.1, 0.7), floats=True)


def seeds_lpbus() -> list[bytes]:
    """Return data packets."""
    return [b"".join(encode(9, _packet(4 * n)) for n in range(count)) for count in (1, 5)]


def seeds_lpms_records() -> list[bytes]:
    """Return a reply with the outputs, the firmware version, and data packets, as records."""
    setting = LpmsConfiguration(GENERATION_1.quaternion, 100, floats=True)
    reply = encode_reply(GENERATION_1, 0x04, setting)
    packets = b"".join(b"\x09\x14" + _packet(4 * n) for n in range(4))
    return [b"\x04\x04" + reply + b"\x2f\x0c" + bytes(12) + packets, packets]


def seeds_lpms_can() -> list[bytes]:
    """Return frames of both precisions and a heartbeat, as records."""
    q = (0.5, -0.5, 0.1, 0.7)
    shorts = encode_frames(_IDS, [10_000 * part for part in q] + [0.0] * 12, "int16")
    floats = encode_frames(_IDS, [*q, 0.0, 0.0, 0.0, 0.0], "float32")
    found = [
        b"".join(bytes((k, 8)) + frame.data for k, frame in enumerate(frames))
        for frames in (shorts, floats)
    ]
    return [*found, b"\x04\x08\x05" + bytes(7) + found[0]]


TARGETS = (
    Target("lpbus-bytes", run_lpbus_bytes, seeds_lpbus, share=20),
    Target("lpms-decoder", run_lpms_decoder, seeds_lpms_records, share=10),
    Target("lpms-can-decoder", run_lpms_can, seeds_lpms_can, share=5),
)
