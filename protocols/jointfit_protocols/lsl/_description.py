"""Description of a stream as liblsl and XDF write it: XML with one element for each channel.

Source: https://github.com/sccn/xdf/wiki/MoCap-Meta-Data.
"""

from __future__ import annotations

from typing import NamedTuple
from xml.etree import ElementTree as ET

FORMATS = {
    "float32": "f", "double64": "d", "int8": "b", "int16": "h", "int32": "i", "int64": "q",
}  # fmt: skip
"""Number formats of the samples, and their codes in `struct`."""
MOST_CHANNELS = 20_000
"""Largest accepted number of channels."""
_LARGEST_XML = 8 << 20
"""Largest accepted description, bytes."""
_FASTEST_HZ = 1e6


class Channel(NamedTuple):
    """Description of one channel. Fields that are not described are empty."""

    label: str = ""
    marker: str = ""
    object: str = ""
    type: str = ""
    unit: str = ""


class StreamDescription(NamedTuple):
    """Description of a stream."""

    name: str
    type: str
    channel_count: int
    channel_format: str
    """Format of the samples: a key of `FORMATS`, ``string``, or an unknown text."""
    rate_hz: float
    """Nominal rate, Hz; 0 for an irregular stream."""
    source_id: str
    hostname: str
    channels: tuple[Channel, ...]
    """Description of every channel; empty unless the stream describes all channels."""
    manufacturer: str
    model: str
    compensated_lag_s: float
    """Delay of the device for which the time stamps are already corrected, s."""


def parse_description(data: bytes) -> StreamDescription | str:
    """Return the description in an XML document, or the reason why there is no valid one."""
    if len(data) > _LARGEST_XML:
        return "description too long"
    if b"<!" in data:  # a document type may define entities of any size
        return "description with a document type"
    try:
        root = ET.fromstring(data)  # noqa: S314 - without a document type there are no entities
    except (ET.ParseError, ValueError, LookupError, RecursionError):
        return "description is no XML document"

    count = _text(root, "channel_count")
    if not (count.isascii() and count.isdecimal() and len(count) < 8):  # noqa: PLR2004 - digits
        return "description without a number of channels"
    if not 0 < int(count) <= MOST_CHANNELS:
        return f"{count} channels, expected 1 to {MOST_CHANNELS}"
    described = root.findall("desc/channels/channel")
    channels = tuple(Channel(*(_text(one, name) for name in Channel._fields)) for one in described)
    return StreamDescription(
        _text(root, "name"),
        _text(root, "type"),
        int(count),
        _text(root, "channel_format"),
        _number(root, "nominal_srate", _FASTEST_HZ),
        _text(root, "source_id"),
        _text(root, "hostname"),
        channels if len(channels) == int(count) else (),
        _text(root, "desc/acquisition/manufacturer"),
        _text(root, "desc/acquisition/model"),
        _number(root, "desc/acquisition/compensated_lag", 10.0),
    )


def _text(root: ET.Element, path: str) -> str:
    return (root.findtext(path) or "").strip()


def _number(root: ET.Element, path: str, largest: float) -> float:
    """Return the number at `path`, from 0 to `largest`; 0 if there is none."""
    try:
        value = float(_text(root, path) or 0.0)
    except ValueError:
        return 0.0
    return value if 0.0 < value <= largest else 0.0
