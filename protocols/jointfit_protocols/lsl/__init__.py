"""One stream of the Lab Streaming Layer (LSL) as chunks of an XDF file, in both directions.

The library liblsl delivers samples, not bytes. The driver converts them to XDF chunks. A recording
therefore contains the complete content of the stream, and a replay decodes the same input.
"""

from jointfit_protocols.lsl._chunks import (
    LslCodec,
    LslMessage,
    RoundTrip,
    Samples,
    encode_description,
    encode_round_trip,
    encode_samples,
)
from jointfit_protocols.lsl._description import (
    FORMATS,
    MOST_CHANNELS,
    Channel,
    StreamDescription,
    parse_description,
)

__all__ = [
    "FORMATS",
    "MOST_CHANNELS",
    "Channel",
    "LslCodec",
    "LslMessage",
    "RoundTrip",
    "Samples",
    "StreamDescription",
    "encode_description",
    "encode_round_trip",
    "encode_samples",
    "parse_description",
]
