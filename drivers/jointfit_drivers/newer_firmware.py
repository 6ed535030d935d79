"""Detection of devices that are newer than the protocol descriptions that their codec follows.

Two signs indicate newer firmware: the version that the device reports, and well-formed message
contents of unknown kind or length. Both signs only cause warnings. Contents that the codec can
decode are still used.

Invariant: the output depends only on the calls. The module reads no clock and no port.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from jointfit_daemon.model import DeviceEvent

if TYPE_CHECKING:
    from jointfit_daemon.model import Decoded

_SIGHTINGS = 10
"""Number of unknown contents of one kind that causes a warning. A smaller number proves nothing,
because a weak checksum accepts some corrupt messages."""
_WITHIN_NS = 60_000_000_000
"""Longest time between the first and the last of these `_SIGHTINGS` contents, ns."""
_MOST_KINDS = 16
"""Largest number of kinds of unknown contents that are counted and reported."""
_NUMBER = re.compile(r"\d{1,9}")


@dataclass(frozen=True, slots=True)
class NewestKnown:
    """Newest version that the codec of a device family supports, and the vendor's program."""

    version: tuple[int, ...]
    """Leading numbers of the version. If only the other numbers change, the message
    contents stay the same."""
    tool: str
    """Vendor's program that selects outputs and installs firmware."""
    part: str = "firmware"
    """Name of the part that has this version: ``firmware``, or a protocol."""

    @property
    def text(self) -> str:
        """`version` as text. If `version` has one number, ``.x`` stands for the other numbers."""
        return ".".join(map(str, self.version)) + (".x" if len(self.version) == 1 else "")


class NewerFirmwareDetector:
    """Warns if one device is newer than the supported version.

    Parameters
    ----------
    newest : NewestKnown, optional
        Newest supported version; None if devices of the family report no comparable version.
    tool : str
        Program that selects the outputs; only used if `newest` is None.
    sightings : int
        Number of unknown contents of one kind that causes a warning. Use 1 for a connection without
        transmission errors.
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
        self._seen: dict[str, tuple[int, int]] = {}  # count, arrival of the first content, ns

    @property
    def is_settled(self) -> bool:
        """Whether all kinds of unknown contents received so far were reported."""
        return all(count >= self._sightings for count, _ in self._seen.values())

    def take_version(self, found: str) -> list[Decoded]:
        """Return a warning, once per version, if the device reports a newer version."""
        self._found = found
        newest = self._newest
        if newest is None or found == self._reported:
            return []
        numbers = tuple(map(int, _NUMBER.findall(found)))[: len(newest.version)]
        if numbers <= newest.version:
            return []
        self._reported = found
        text = (
            f"{newest.part} {found} is newer than {newest.text}, the newest known version; known "
            f"contents are used: update jointfitd, or return to {newest.part} {newest.text} with "
            f"{newest.tool}; then compare the angles with `jointfit probe --physical-test`"
        )
        return [DeviceEvent("warning", text, self._data())]

    def take_unknown(self, content: str, t_ns: int) -> list[Decoded]:
        """Return a warning, once per kind, if contents of an unknown kind arrive repeatedly.

        Parameters
        ----------
        content
            Name of the kind of content, with its number or size, such as ``message 0x77``.
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
            f"the device sends {content}, which jointfitd does not know ({self._part} {found}"
            f"{newest}); it is ignored, known contents are used: update jointfitd, or disable this "
            f"output with {self._tool}"
        )
        return [DeviceEvent("warning", text, {"unknown": content, **self._data()})]

    def _data(self) -> dict[str, object]:
        """Return the reported version and the newest supported version, if they are known."""
        newest = None if self._newest is None else self._newest.text
        known = {"found": self._found or None, "newest_known": newest}
        return {key: value for key, value in known.items() if value is not None}
