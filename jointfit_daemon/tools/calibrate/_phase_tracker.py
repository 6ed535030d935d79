"""Follows a calibration phase from its request to its stored result, from MQTT messages.

`jointfit calibrate` and `jointfit demo` both use it; the caller owns the MQTT client.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

STORING_S = 1.5
"""Longest wait for the version number of a stored result, s."""


class PhaseAbortedError(Exception):
    """The daemon aborted the phase, or cannot be reached; the message gives the reason."""


class RequestRefusedError(Exception):
    """The daemon rejected the request; the message gives the reason."""


@dataclass(slots=True)
class PhaseTracker:
    """Collects calibration messages and lets a task wait for the end of a phase."""

    show: Callable[[str, float, str], None]
    """Callback for phase, progress (0 to 1) and text of each progress message."""
    show_details: Callable[[Mapping[str, Any]], None] | None = None
    """Callback for the ``data`` of each progress message, called after `show`."""
    status: Mapping[str, Any] = field(default_factory=dict)
    _changed: asyncio.Event = field(default_factory=asyncio.Event)
    _unread: list[Mapping[str, Any]] = field(default_factory=list)
    _failure: Exception | None = None

    def on_status(self, payload: Mapping[str, Any]) -> None:
        """Process a message of topic ``calibration``."""
        self.status = payload
        self._unread.append(payload)
        self._changed.set()

    def on_progress(self, payload: Mapping[str, Any]) -> None:
        """Process a message of topic ``calibration/progress``."""
        done = payload.get("progress") or 0.0
        self.show(str(payload.get("phase", "")), float(done), str(payload.get("text", "")))
        if self.show_details is not None:
            self.show_details(payload.get("data") or {})

    def fail(self, error: Exception) -> None:
        """Report that no further messages will arrive; waiting tasks raise `error`."""
        self._failure = error
        self._changed.set()

    def begin(self) -> None:
        """Discard the messages received so far."""
        self._unread.clear()
        self._changed.clear()

    async def wait_for_end(self, phase: str) -> Mapping[str, Any]:
        """Wait until `phase` has begun and ended; return the status message that ended it.

        Messages before the first one of `phase` are ignored: a retained status may arrive late.

        Raises
        ------
        PhaseAbortedError
            The daemon aborted the phase; the message gives its reason.
        """
        began = False
        while True:
            for status in self._unread:
                current = status.get("phase")
                if current == phase:
                    began = True
                elif began and current == "aborted":
                    why = status.get("text", "no reason given")
                    raise PhaseAbortedError(f"{phase} was aborted: {why}")
                elif began and current != "fitting":
                    return status
            self._unread.clear()
            await self._next_message()

    async def wait_for_store(self, ended: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the status with the stored version; `ended` if nothing is stored in time."""
        with suppress(TimeoutError):
            async with asyncio.timeout(STORING_S):
                while self.status.get("version") == ended.get("version"):
                    await self._next_message()
                return self.status
        return ended

    async def _next_message(self) -> None:
        if self._failure is not None:
            raise self._failure
        self._changed.clear()
        await self._changed.wait()
        if self._failure is not None:
            raise self._failure
