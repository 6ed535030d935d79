"""Descriptions of one file of a recording, and of missing messages in it.

Invariant: a changed bit in a description is detected, because metadata contain a checksum.
"""

from __future__ import annotations

import zlib
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import orjson

if TYPE_CHECKING:
    from collections.abc import Mapping

_CHECKSUM = "crc32"
"""Key of the checksum in metadata records. The MCAP format itself has no such checksum."""


@dataclass(frozen=True, slots=True)
class RecordingInfo:
    """Description of one file of a recording."""

    format: int
    """Version of the channels and metadata."""
    session: str
    """Random identifier, equal in all parts of one session."""
    part: int
    """Number of the file within its session, from 1."""
    rig: str
    """Name of the rig, ``[rig] name``."""
    began_with_daemon: bool
    """Whether the session contains every event since the start of the daemon."""
    unix_offset_ns: int
    """UNIX time minus CLOCK_MONOTONIC, ns; it applies to all stamps of this file."""
    first_sequence: int
    """Sequence number of the first message in this file."""
    start_t_ns: int
    """Time at which this file begins, CLOCK_MONOTONIC ns."""
    software: str
    """Names and versions of the programs that wrote the file."""

    @property
    def program(self) -> str:
        """Name and version of the daemon that wrote the file."""
        return self.software.partition(",")[0]

    def metadata(self) -> dict[str, str]:
        """Return the metadata record of this file."""
        return seal({key: orjson.dumps(value).decode() for key, value in asdict(self).items()})

    @classmethod
    def from_metadata(cls, given: Mapping[str, str]) -> RecordingInfo:
        """Return the description in a metadata record with a correct checksum.

        Raises
        ------
        ValueError
            The checksum is wrong, or a key is missing or has another type.
        """
        values = {key: orjson.loads(text) for key, text in unseal(given).items()}
        kinds = {"session": str, "rig": str, "software": str, "began_with_daemon": bool}
        fields = cls.__dataclass_fields__
        for key in fields:
            if type(values.get(key)) is not kinds.get(key, int):
                raise ValueError(f"{key} of the recording is {values.get(key)!r}")
        return cls(**{key: values[key] for key in fields})


@dataclass(frozen=True, slots=True)
class RecordingGap:
    """A gap, which is a range of consecutive messages missing in a recording."""

    first_sequence: int
    count: int
    from_t_ns: int
    """Stamp of the last message before the gap, CLOCK_MONOTONIC ns."""
    to_t_ns: int
    """Stamp of the first message after the gap, CLOCK_MONOTONIC ns."""
    reason: str

    @property
    def seconds(self) -> float:
        """Duration of the gap, s."""
        return (self.to_t_ns - self.from_t_ns) * 1e-9

    def text(self) -> str:
        """Return the gap as a sentence."""
        last = self.first_sequence + self.count - 1
        return (
            f"{self.count} messages ({self.first_sequence} to {last}, {self.seconds:.3f} s) are "
            f"missing: {self.reason}"
        )


def seal(values: Mapping[str, str]) -> dict[str, str]:
    """Return `values` with their checksum."""
    return {**values, _CHECKSUM: f"{_checksum(values):08x}"}


def unseal(given: Mapping[str, str]) -> dict[str, str]:
    """Return the values of a metadata record without their checksum.

    Raises
    ------
    ValueError
        The checksum is missing or wrong.
    """
    values = {key: value for key, value in given.items() if key != _CHECKSUM}
    if given.get(_CHECKSUM) != f"{_checksum(values):08x}":
        raise ValueError("damaged metadata: their checksum is wrong")
    return values


def _checksum(values: Mapping[str, str]) -> int:
    return zlib.crc32(repr(sorted(values.items())).encode())
