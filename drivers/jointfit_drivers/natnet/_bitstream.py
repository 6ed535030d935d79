"""Bitstream version of one NatNet server, changed only by a datagram that confirms the new one.

An announced version is a candidate. The candidate is adopted when a frame or a model cannot be
decoded with the version in use and decodes exactly with the candidate. A forged announcement alone
therefore changes nothing.

Invariant: pure.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.natnet import (
    FrameLayout,
    FrameOfData,
    NatNetMessageId,
    decode,
    is_versioned,
    supported,
)

if TYPE_CHECKING:
    from jointfit_protocols.natnet import Message, Version

UNKNOWN: Version = (0, 0)
_MOST_LAYOUTS = 64
"""Lengths of frames whose layouts are stored."""
FRAME_START = int(NatNetMessageId.FRAMEOFDATA).to_bytes(2, "little")
"""First bytes of a datagram with a frame, in every bitstream."""


class BitstreamTracker:
    """Decodes datagrams with the version in use and tracks its changes.

    Parameters
    ----------
    wanted : tuple of int, optional
        Version that rig.toml requests from the server; always a candidate.
    """

    def __init__(self, wanted: Version | None = None) -> None:
        self.version = UNKNOWN
        self._wanted = wanted
        self._announced: Version | None = None
        self._confirmed: Version | None = None
        self._layouts: dict[tuple[Version, int], FrameLayout] = {}
        """Layout of the last frame with this version and length; a server sends few lengths."""
        self._selected: frozenset[str] | None = None
        """Marker sets that are read from frames of a known layout; None for all."""

    @property
    def known(self) -> bool:
        """Whether the server has announced its version."""
        return self.version != UNKNOWN

    def announce(self, version: Version) -> None:
        """Process the version of a SERVERINFO: the first is used, later versions are candidates."""
        self._announced = version
        if not self.known or not supported(self.version):
            self.version = version

    def confirm(self, version: Version) -> None:
        """Add the version of a RESPONSE as a candidate."""
        self._confirmed = version

    def select_sets(self, names: frozenset[str]) -> None:
        """Leave out the other marker sets, and unlabeled markers, where it saves time."""
        if names != self._selected:
            self._selected = names
            self._layouts.clear()

    def restart(self, version: Version) -> None:
        """Use the version of another server at the same address."""
        self.version = self._announced = version
        self._confirmed = None

    def decode(self, datagram: bytes) -> Message | CorruptBytes:
        """Return the message in `datagram`; adopt a candidate that alone decodes it."""
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
