"""Fuzz targets of VectorNav: the codec with any bytes, the decoder with valid checksums."""

from __future__ import annotations

from contextlib import suppress

from jointfit_daemon.model import Chunk
from jointfit_drivers.vectornav import VectorNavImu
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.vectornav import VectorNavCodec, encode_text
from tests.drivers.vectornav.vectornav_messages import PERIOD_NS, output, settings
from tests.fuzz.target import Target, UnaccountedError
from tests.fuzz.wire_targets import cut, records


def run_vectornav_bytes(data: bytes) -> None:
    """Decode serial bytes in pieces; every byte belongs to a message or is counted."""
    codec, found = VectorNavCodec(), []
    for piece in cut(data):
        found += codec.feed(piece)
    found += codec.flush()
    used = sum(item.discarded if isinstance(item, CorruptBytes) else item.size for item in found)
    if used != len(data):
        raise UnaccountedError(f"{len(data)} bytes, {used} in messages or discarded")


def run_vectornav_decoder(data: bytes) -> None:
    """Decode binary outputs and texts whose device times and contents come from `data`."""
    decoder = VectorNavImu(settings()).decoder()
    for number, (kind, content) in enumerate(records(data)):
        t_ns = number * PERIOD_NS
        decoder.feed(Chunk(t_ns, output(int.from_bytes(content[:8], "little"))))
        with suppress(ValueError):  # content that no device can send
            decoder.feed(Chunk(t_ns, encode_text(f"VNRRG,{kind},{content.decode('latin-1')}")))
    decoder.flush()


def seeds_vectornav() -> list[bytes]:
    """Return binary outputs that alternate with texts."""
    text = encode_text("VNYMR,+100.949,-007.330,+000.715")
    return [b"".join(output(n * PERIOD_NS) + text for n in range(count)) for count in (1, 5)]


def seeds_vectornav_records() -> list[bytes]:
    """Return registers as records."""
    return [b"\x4b\x0b3,8,01,0011x", b"\x1a\x111,0,0,0,1,0,0,0,1", b"\x01\x07VN-100S"]


TARGETS = (
    Target("vectornav-bytes", run_vectornav_bytes, seeds_vectornav, share=20),
    Target("vectornav-decoder", run_vectornav_decoder, seeds_vectornav_records, share=10),
)
