"""Detection of a device that is newer than the descriptions that its codec follows.

Two signs indicate newer firmware: the version that the device reports, and well-formed contents of
unknown kind or length. Both signs cause warnings only: contents that a codec decodes remain in use.

Invariant: the output depends only on the calls; no clock and no port is read.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from jointfit_daemon.model import DeviceEvent

if TYPE_CHECKING:
    from jointfit_daemon.model import Decoded

_SIGHTINGS = 10
"""Unknown contents of one kind after which a warning is returned. Fewer prove nothing, because a
weak checksum accepts some corrupt messages."""
_WITHIN_NS = 60_000_000_000
"""Longest time between the first and the last of these contents, ns."""
_MOST_KINDS = 16
"""Most kinds of unknown contents that are counted and reported."""
_NUMBER = re.compile(r"\d{1,9}")


@dataclass(frozen=True, slots=True)
class NewestKnown:
    """Newest version of a family that the codec supports, and the program that installs it."""

    version: tuple[int, ...]
    """Leading numbers of the version; the vendor changes further ones without changing contents."""
    tool: str
    """Program of the vendor that selects outputs and installs firmware."""
    part: str = "firmware"
    """Name of the versioned part: firmware, or a protocol."""

    @property
    def text(self) -> str:
        """Version as text; numbers behind the known ones are ``x``."""
        return ".".join(map(str, self.version)) + (".x" if len(self.version) == 1 else "")


class NewerFirmwareDetector:
    """Reports of one device that it is newer than known.

    Parameters
    ----------
    newest : NewestKnown, optional
        Newest known version; None if devices of the family report no comparable version.
    tool : str
        Program that selects the outputs, for devices without `newest`.
    sightings : int
        Unknown contents of one kind after which a warning is returned; 1 on a connection without
        errors.
    """

    def __init__(
        self, newest: NewestKnown | None = None, *, tool: str = "", sightings: int = _SIGHTINGS
    ) -> None:
        self._newest = newest
        self._tool = tool if newest is None else newest.tool
        self._part = "firmware" if newest is None else newest.part
        self._sightings = sightings
        self._found = ""
        self._reported = ""
        self._seen: dict[str, tuple[int, int]] = {}  # count, and time of the first one

    @property
    def is_settled(self) -> bool:
        """Whether every kind of unknown contents so far was reported."""
        return all(count >= self._sightings for count, _ in self._seen.values())

    def take_version(self, found: str) -> list[Decoded]:
        """Return a warning, once a version, if the device reports a newer one than known."""
        self._found = found
        newest = self._newest
        if newest is None or found == self._reported:
            return []
        numbers = tuple(map(int, _NUMBER.findall(found)))[: len(newest.version)]
        if numbers <= newest.version:
            return []
        self._reported = found
        text = (
            f"{newest.part} {found} is newer than {newest.text}, the newest known here; known "
            f"contents are used: update jointfitd, or return to {newest.part} {newest.text} with "
            f"{newest.tool}; then compare the angles with `jointfit probe --physical-test`"
        )
        return [DeviceEvent("warning", text, self._data())]

    def take_unknown(self, content: str, t_ns: int) -> list[Decoded]:
        """Return a warning, once, if contents of a kind that the codec does not know repeat.

        Parameters
        ----------
        content
            Name of the content with number or size, such as ``message 0x77``.
        t_ns
            Arrival time of the content, monotonic ns.
        """
        count, since_ns = self._seen.get(content, (0, t_ns))
        if count >= self._sightings or (not count and len(self._seen) >= _MOST_KINDS):
            return []
        if t_ns - since_ns > _WITHIN_NS:
            count, since_ns = 0, t_ns
        self._seen[content] = (count + 1, since_ns)
        if count + 1 < self._sightings:
            return []
        found = self._found or "not reported"
        newest = "" if self._newest is None else f", newest known {self._newest.text}"
        text = (
            f"the device sends {content}, which this version does not know ({self._part} {found}"
            f"{newest}); it is ignored, known contents are used: update jointfitd, or disable this "
            f"output with {self._tool}"
        )
        return [DeviceEvent("warning", text, {"unknown": content, **self._data()})]

    def _data(self) -> dict[str, object]:
        """Return the version found and the newest known one, each if it exists."""
        newest = None if self._newest is None else self._newest.text
        known = {"found": self._found or None, "newest_known": newest}
        return {key: value for key, value in known.items() if value is not None}
