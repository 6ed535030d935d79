"""One stream of the Lab Streaming Layer as chunks of an XDF file, in both directions.

liblsl delivers samples, not bytes. The driver writes them as XDF chunks, so that a recording
contains what the stream contained, and a replay decodes the same input.
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
