"""Fuzz target of LSL streams: chunks up to optical frames."""

from __future__ import annotations

from functools import cache

from jointfit_daemon.model import Chunk, Corrupt
from jointfit_drivers.lsl_markers import LslMarkersDecoder, LslMarkersSettings
from jointfit_protocols.lsl import (
    RoundTrip,
    encode_description,
    encode_round_trip,
    encode_samples,
)
from tests.fuzz.target import Target, UnaccountedError
from tests.fuzz.wire_targets import cut
from tests.pipeline.core_feed import BEGIN_NS

_MS = 1_000_000


def run_lsl(data: bytes) -> None:
    """Decode the chunks of a stream, up to frames; every discarded byte is reported."""
    decoder = LslMarkersDecoder(LslMarkersSettings(driver="lsl-markers"))
    lost, t_ns = 0, BEGIN_NS
    for piece in (seeds_lsl()[0], data, *cut(data)):
        t_ns += _MS
        found = decoder.feed(Chunk(t_ns, piece))
        lost += sum(item.discarded for item in found if isinstance(item, Corrupt))
    if lost != decoder.discarded_bytes:
        raise UnaccountedError(f"{decoder.discarded_bytes} bytes discarded, {lost} reported")


@cache
def seeds_lsl() -> list[bytes]:
    """Return chunks of a stream with one marker: description, samples and a clock comparison."""
    channels = "".join(
        f"<channel><marker>T1</marker><type>Position{axis}</type></channel>" for axis in "XYZ"
    )
    description = encode_description(
        "<info><channel_count>3</channel_count><nominal_srate>100</nominal_srate><channel_format>"
        f"float32</channel_format><desc><channels>{channels}</channels></desc></info>"
    )
    samples = encode_samples("float32", [1.0, 1.01], [(0.1, 0.2, 0.3), (0.0, 0.0, 0.0)])
    trip = encode_round_trip(RoundTrip(BEGIN_NS, BEGIN_NS + 1000, 1.0))
    return [description, samples + trip, description + samples + trip]


TARGETS = (Target("lsl-source", run_lsl, seeds_lsl, share=4, longest=2000),)
