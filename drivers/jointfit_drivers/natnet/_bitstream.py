"""Bitstream version of one NatNet server. The version defines the binary layout of the messages.

A version that the server announces is used at once if no supported version is in use. Otherwise it
is a candidate. A candidate is used from the first frame or model that decodes exactly with the
candidate, but not with the version in use. A forged announcement then changes nothing.

Invariant: the module is pure.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.natnet import (
    FrameLayout,
    FrameOfData,
    NatNetMessageId,
    decode,
    is_supported,
    is_versioned,
)

if TYPE_CHECKING:
    from jointfit_protocols.natnet import Message, Version

UNKNOWN: Version = (0, 0)
_MOST_LAYOUTS = 64
"""Largest number of stored layouts of frames, one per version and length."""
FRAME_START = int(NatNetMessageId.FRAMEOFDATA).to_bytes(2, "little")
"""First bytes of a datagram that contains a frame, in every bitstream version."""


class BitstreamTracker:
    """Decodes datagrams with the version in use, and detects changes of the version.

    Parameters
    ----------
    wanted : tuple of int, optional
        Version that rig.toml requests from the server. It is always a candidate.
    """

    def __init__(self, wanted: Version | None = None) -> None:
        self.version = UNKNOWN
        self._wanted = wanted
        self._announced: Version | None = None
        self._confirmed: Version | None = None
        self._layouts: dict[tuple[Version, int], FrameLayout] = {}
        """Layout of the last frame for each version and length. Frames of a server have few
        lengths."""
        self._selected: frozenset[str] | None = None
        """Marker sets that are read from frames with a known layout; None for all sets."""

    @property
    def known(self) -> bool:
        """Whether the server has announced its version."""
        return self.version != UNKNOWN

    def announce(self, version: Version) -> None:
        """Add the version in a SERVERINFO as a candidate.

        The version is used at once if the version in use is unknown or not supported.
        """
        self._announced = version
        if not self.known or not is_supported(self.version):
            self.version = version

    def confirm(self, version: Version) -> None:
        """Add the version in a RESPONSE as a candidate."""
        self._confirmed = version

    def select_sets(self, names: frozenset[str]) -> None:
        """Skip unlabeled markers and all marker sets except `names` in frames of a known layout."""
        if names != self._selected:
            self._selected = names
            self._layouts.clear()

    def restart(self, version: Version) -> None:
        """Use the version of a different server at the same address."""
        self.version = self._announced = version
        self._confirmed = None

    def decode(self, datagram: bytes) -> Message | CorruptBytes:
        """Return the message in `datagram`. If only a candidate decodes it, use the candidate."""
        key = self.version, len(datagram)
        layout = self._layouts.get(key)
        if layout is not None:
            frame = layout.read(datagram)
            if frame is not None:
                return frame

        message = decode(datagram, self.version)
        if isinstance(message, FrameOfData):
            new = FrameLayout.of(datagram, message, self.version, self._selected)
            if new is not None:
                if len(self._layouts) >= _MOST_LAYOUTS:  # the number of markers varies
                    self._layouts.clear()
                self._layouts[key] = new
        if not isinstance(message, CorruptBytes) or not self.known or not is_versioned(datagram):
            return message

        for candidate in dict.fromkeys((self._announced, self._confirmed, self._wanted)):
            if candidate is None or candidate == self.version:
                continue
            found = decode(datagram, candidate)
            if not isinstance(found, CorruptBytes):
                self.version = candidate
                return found
        return message
