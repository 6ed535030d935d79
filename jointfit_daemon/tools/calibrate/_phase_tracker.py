"""Tracks a calibration phase from its request to its stored result, by means of MQTT messages.

The commands `jointfit calibrate` and `jointfit demo` use this module. The caller provides the MQTT
client.
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
RETAINED_S = 1.0
"""Longest wait for the retained status after the subscription, s."""
OFFLINE_S = 60.0
"""Longest wait until an offline daemon is online again, s. A restart on a Raspberry Pi takes less.
"""


def is_not_stored(status: Mapping[str, Any]) -> bool:
    """Return whether the daemon uses the calibration of `status` but could not store it."""
    return "not stored" in str(status.get("text", ""))


class PhaseAbortedError(Exception):
    """The daemon aborted the phase, or cannot be reached; the message gives the reason."""


class RequestRefusedError(Exception):
    """The daemon rejected the request; the message gives the reason."""


def raise_if_refused(answer: Mapping[str, Any]) -> None:
    """If the daemon rejected the request, raise `RequestRefusedError` with the daemon's message."""
    if answer.get("status") == "error":
        raise RequestRefusedError(str((answer.get("error") or {}).get("message")))


@dataclass(slots=True)
class PhaseTracker:
    """Collects calibration messages, and notifies a waiting task of the end of a phase."""

    show: Callable[[str, float, str], None]
    """Callback for phase, progress (0 to 1) and text of each progress message."""
    show_details: Callable[[Mapping[str, Any]], None] | None = None
    """Callback for the ``data`` of each progress message, called after `show`."""
    status: Mapping[str, Any] = field(default_factory=dict)
    _changed: asyncio.Event = field(default_factory=asyncio.Event)
    _unread: list[Mapping[str, Any]] = field(default_factory=list)
    """Status messages to process. A status without a phase represents an interruption."""
    _failure: Exception | None = None
    _waiting: bool = False
    """Whether a task waits for the end of a phase."""
    _offline_until: float | None = None
    """Time at which the wait for the daemon ends, in seconds of the event loop's clock. None while
    the daemon is online."""
    _requested: bool = False
    """Whether the phase was requested. A message that arrives before the request is a retained
    message or belongs to another phase."""
    _phase_before: object = None
    """Phase in the last status before the request."""
    _status_before: object = None
    """The last status before the request."""

    def on_status(self, payload: Mapping[str, Any]) -> None:
        """Process a message of topic ``calibration``."""
        self.status = payload
        if self._requested:
            self._unread.append(payload)
        self._changed.set()

    @property
    def is_requested(self) -> bool:
        """Whether `begin` was called."""
        return self._requested

    def has_begun(self, phase: str) -> bool:
        """Return whether a status after the request shows that the request started `phase`."""
        began = any(status.get("phase") == phase for status in self._unread)
        return began and self._phase_before != phase

    def on_progress(self, payload: Mapping[str, Any]) -> None:
        """Process a message of topic ``calibration/progress``."""
        if payload.get("phase") == "aborted":  # the error message of the command has the reason
            return
        done = payload.get("progress") or 0.0
        self.show(str(payload.get("phase", "")), float(done), str(payload.get("text", "")))
        if self.show_details is not None:
            self.show_details(payload.get("data") or {})

    def on_state(self, state: object) -> str | None:
        """Process the state in a message ``bridge/state``; return a line for the user, or None."""
        before = self._offline_until
        if state == "online":
            self._offline_until = None
            return "the daemon is online again" if before is not None and self._waiting else None
        if before is not None:
            return None

        self._offline_until = asyncio.get_running_loop().time() + OFFLINE_S
        if not self._waiting:
            return None
        self._unread.append({})
        self._changed.set()
        return f"the daemon is offline: waiting up to {OFFLINE_S:g} s for it"

    def fail(self, error: Exception) -> None:
        """Report that no further messages will arrive; waiting tasks raise `error`."""
        self._failure = error
        self._changed.set()

    async def wait_for_retained(self) -> None:
        """Wait at most `RETAINED_S` for the retained status, before the request is sent."""
        with suppress(TimeoutError):
            async with asyncio.timeout(RETAINED_S):
                while not self.status:
                    await self._next_message()

    def begin(self) -> None:
        """Discard all messages received before the request."""
        self._requested, self._phase_before = True, self.status.get("phase")
        self._status_before = self.status
        self._unread.clear()
        self._changed.clear()
        self._waiting = False

    async def wait_for_end(self, phase: str) -> Mapping[str, Any]:
        """Wait until `phase` has begun and ended; return the status at the end of the phase.

        A retained status may arrive late, so all messages before the first message of `phase` are
        ignored.

        Raises
        ------
        PhaseAbortedError
            The daemon aborted the phase, was restarted, or was offline for `OFFLINE_S`; the message
            gives the reason.
        """
        began, interrupted, version = False, False, self.status.get("version")
        self._waiting = True
        while True:
            for status in self._unread:
                current = status.get("phase")
                if current is None:
                    began = interrupted = True
                elif current == phase:
                    began, version = True, status.get("version")
                elif began and current == "aborted":
                    why = status.get("text", "no reason given")
                    raise PhaseAbortedError(f"{phase} was aborted: {why}")
                elif began and current != "fitting":
                    # The status of a completed phase has a new version, or the reason why the
                    # version is unchanged.
                    restored = current == "calibrated" and status.get("version") == version
                    if interrupted and (
                        current == "uncalibrated"
                        or (restored and version is not None and status.get("kept") is None)
                    ):
                        raise PhaseAbortedError(
                            f"{phase} was lost when the daemon was restarted: repeat it"
                        )
                    return status
            self._unread.clear()
            await self._next_message()

    async def wait_for_final(self, phase: str) -> Mapping[str, Any]:
        """Return the status after the end of `phase`.

        If the phase was not aborted, the method waits up to `STORING_S` for the stored result.
        """
        while self.status is self._status_before or self.status.get("phase") in (phase, "fitting"):
            await self._next_message()
        ended = self.status
        return ended if ended.get("phase") == "aborted" else await self.wait_for_store(ended)

    async def wait_for_store(self, ended: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the status with the stored version or the failure, or `ended` after a timeout."""
        with suppress(TimeoutError):
            async with asyncio.timeout(STORING_S):
                while self.status.get("version") == ended.get("version"):
                    if is_not_stored(self.status):
                        break
                    await self._next_message()
                return self.status
        return ended

    async def _next_message(self) -> None:
        if self._failure is not None:
            raise self._failure
        self._changed.clear()
        try:
            async with asyncio.timeout_at(self._offline_until):
                await self._changed.wait()
        except TimeoutError as late:
            raise PhaseAbortedError(
                f"the daemon was offline for {OFFLINE_S:g} s: check that jointfitd runs and reaches"
                " the broker"
            ) from late
        if self._failure is not None:
            raise self._failure
