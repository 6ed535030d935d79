"""Fuzz targets of MIP: serial bytes, and fields in valid packets up to samples."""

from __future__ import annotations

from jointfit_daemon.model import Chunk
from jointfit_drivers.mip import MipImu
from jointfit_protocols.mip import MAX_PAYLOAD, MipCodec, MipPacket, encode
from tests.drivers.mip.mip_packets import PERIOD_NS, filter_packet, sensor_packet, settings
from tests.fuzz.target import Target, UnaccountedError
from tests.fuzz.wire_targets import cut, records

_LONGEST_FIELD = MAX_PAYLOAD - 2


def run_mip_bytes(data: bytes) -> None:
    """Decode serial bytes in pieces; every byte belongs to a packet or is counted."""
    codec, found = MipCodec(), []
    for piece in cut(data):
        found += codec.feed(piece)
    found += codec.flush()
    used = sum(item.size if isinstance(item, MipPacket) else item.discarded for item in found)
    if used != len(data):
        raise UnaccountedError(f"{len(data)} bytes, {used} in packets or discarded")


def run_mip_decoder(data: bytes) -> None:
    """Put records ``set, field, content`` into valid packets and decode them."""
    decoder = MipImu(settings()).decoder()
    for number, (descriptor_set, content) in enumerate(records(data)):
        field = (content[0] if content else 0, content[1:_LONGEST_FIELD])
        wire = encode(descriptor_set, (field,))
        decoder.feed(Chunk(number * PERIOD_NS, wire))
    decoder.flush()


def seeds_mip() -> list[bytes]:
    """Return packets of both data sets."""
    return [
        b"".join(filter_packet(n * PERIOD_NS) + sensor_packet(n * PERIOD_NS) for n in range(count))
        for count in (1, 5)
    ]


def seeds_mip_records() -> list[bytes]:
    """Return fields of data sets and replies as records."""
    return [b"\x82\x13\x03" + bytes(18), b"\x01\x03\xf1\x03\x00\x0c\x12\xb2" + bytes(16)]


TARGETS = (
    Target("mip-bytes", run_mip_bytes, seeds_mip, share=20),
    Target("mip-decoder", run_mip_decoder, seeds_mip_records, share=10),
)
