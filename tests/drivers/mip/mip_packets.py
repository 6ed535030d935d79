"""Packets of MIP devices for tests of the driver."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from jointfit_daemon.model import Chunk
from jointfit_drivers.mip import MipImu, MipSettings
from jointfit_protocols.mip import encode
from jointfit_protocols.mip.data import encode_field

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.model import Decoded

PERIOD_NS = 10_000_000
NATIVE = (0.5, -0.5, 0.1, 0.7)


def settings(folder: Path | None = None, **more: Any) -> MipSettings:
    port = "p" if folder is None else str(folder / "imu")
    table: dict[str, Any] = {"silence_s": 0.5} | more
    return MipSettings(id="S1", segment="thigh", driver="mip", port=port, **table)


def filter_packet(t_ns: int | None, valid: int = 1, q: tuple[float, ...] = NATIVE) -> bytes:
    """Return a packet of the filter data set; without a time field if `t_ns` is None."""
    time = () if t_ns is None else (encode_field(0x82, 0xD5, t_ns),)
    return encode(0x82, (*time, encode_field(0x82, 0x03, *q, valid)))


def sensor_packet(t_ns: int, q: tuple[float, ...] = NATIVE) -> bytes:
    return encode(0x80, (encode_field(0x80, 0xD5, t_ns), encode_field(0x80, 0x0A, *q)))


def decoded(packets: list[bytes], **more: Any) -> list[Decoded]:
    """Return the output of a decoder for packets that arrive at intervals of one period."""
    decoder = MipImu(settings(**more)).decoder()
    found = [
        event
        for k, data in enumerate(packets)
        for event in decoder.feed(Chunk(k * PERIOD_NS, data))
    ]
    return found + decoder.flush()
