"""Walks a calibration through its phases over MQTT. Law: a client like any other; knows no device.

``jointfit calibrate`` and the demo both lead with it: they differ in who moves.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

ENDS = {
    "align": {"aligned"},
    "static": {"posed"},
    "functional": {"calibrated"},
}
"""Status that ends each phase well; ``aborted`` ends any of them otherwise."""


class PhaseAborted(Exception):  # noqa: N818 - named for what happened
    """The daemon gave the phase up; the text is its reason."""


class RequestRefused(Exception):  # noqa: N818 - named for what happened
    """The daemon did not accept the request; the text is its reason."""


@dataclass(slots=True)
class CalibrationWatch:
    """What the daemon says about its calibration, newest first; wakes who waits for it."""

    show: Callable[[str, float, str], None]
    """Called with phase, progress 0 to 1, text."""
    status: Mapping[str, Any] = field(default_factory=dict)
    _changed: asyncio.Event = field(default_factory=asyncio.Event)
    _seen: list[Mapping[str, Any]] = field(default_factory=list)

    def on_status(self, payload: Mapping[str, Any]) -> None:
        """Take a message of topic ``calibration``."""
        self.status = payload
        self._seen.append(payload)
        self._changed.set()

    def on_progress(self, payload: Mapping[str, Any]) -> None:
        """Take a message of topic ``calibration/progress``."""
        done = payload.get("progress") or 0.0
        self.show(str(payload.get("phase", "")), float(done), str(payload.get("text", "")))

    def begin(self) -> None:
        """Forget what was said before: a retained status is not an answer."""
        self._seen.clear()
        self._changed.clear()

    async def ended(self, phase: str) -> Mapping[str, Any]:
        """Wait until `phase` ends; return the status that ended it.

        Raises
        ------
        PhaseAborted
            The daemon gave up; the reason is its text.
        """
        while True:
            for status in self._seen:
                if status.get("phase") in ENDS[phase]:
                    return status
                if status.get("phase") == "aborted":
                    raise PhaseAborted(str(status.get("text", "no reason given")))
            self._seen.clear()
            self._changed.clear()
            await self._changed.wait()
