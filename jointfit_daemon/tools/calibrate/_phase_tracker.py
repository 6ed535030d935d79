"""Walks a calibration through its phases over MQTT. Law: a client like any other; knows no device.

``jointfit calibrate`` and the demo both lead with it: they differ in who moves.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

STORING_S = 1.5
"""A result is written to the store within this time, or it never will be."""


class PhaseAborted(Exception):  # noqa: N818 - named for what happened
    """The daemon gave the phase up; the text is its reason."""


class RequestRefused(Exception):  # noqa: N818 - named for what happened
    """The daemon did not accept the request; the text is its reason."""


@dataclass(slots=True)
class CalibrationWatch:
    """What the daemon says about its calibration, newest first; wakes who waits for it."""

    show: Callable[[str, float, str], None]
    """Called with phase, progress 0 to 1, text."""
    figures: Callable[[Mapping[str, Any]], None] | None = None
    """Called with the figures of the progress, after `show`."""
    status: Mapping[str, Any] = field(default_factory=dict)
    _changed: asyncio.Event = field(default_factory=asyncio.Event)
    _seen: list[Mapping[str, Any]] = field(default_factory=list)
    _lost: Exception | None = None

    def on_status(self, payload: Mapping[str, Any]) -> None:
        """Take a message of topic ``calibration``."""
        self.status = payload
        self._seen.append(payload)
        self._changed.set()

    def on_progress(self, payload: Mapping[str, Any]) -> None:
        """Take a message of topic ``calibration/progress``."""
        done = payload.get("progress") or 0.0
        self.show(str(payload.get("phase", "")), float(done), str(payload.get("text", "")))
        if self.figures is not None:
            self.figures(payload.get("data") or {})

    def lose(self, why: Exception) -> None:
        """Take that nothing more will come; who waits gets `why`."""
        self._lost = why
        self._changed.set()

    def begin(self) -> None:
        """Forget what was said before."""
        self._seen.clear()
        self._changed.clear()

    async def ended(self, phase: str) -> Mapping[str, Any]:
        """Wait until `phase` began and ended; return the status that ended it.

        A retained status of earlier may come late: nothing counts before `phase` itself was told.

        Raises
        ------
        PhaseAborted
            The daemon gave up; the reason is its text.
        """
        began = False
        while True:
            for status in self._seen:
                told = status.get("phase")
                if told == phase:
                    began = True
                elif began and told == "aborted":
                    why = status.get("text", "no reason given")
                    raise PhaseAborted(f"{phase} was aborted: {why}")
                elif began and told != "fitting":
                    return status
            self._seen.clear()
            await self._news()

    async def stored(self, ended: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the status that names the version in the store; `ended` if none was written."""
        with suppress(TimeoutError):
            async with asyncio.timeout(STORING_S):
                while self.status.get("version") == ended.get("version"):
                    await self._news()
                return self.status
        return ended

    async def _news(self) -> None:
        if self._lost is not None:
            raise self._lost
        self._changed.clear()
        await self._changed.wait()
        if self._lost is not None:
            raise self._lost
