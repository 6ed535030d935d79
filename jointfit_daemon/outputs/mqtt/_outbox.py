"""What waits to be published. Law: bounded, the oldest goes first, what goes is counted.

Three kinds wait apart: state (retained; the last value wins, and all of it is sent again on every
connection), events (each matters), and streams (late is worthless).
"""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING

from jointfit_daemon.outputs.mqtt._connection import Outgoing

if TYPE_CHECKING:
    from collections.abc import Callable

STREAM_EXPIRY_S = 2
RESPONSE_EXPIRY_S = 30

_STREAMS = 200  # a second or two of poses and what goes beside them
_EVENTS = 256


class Outbox:
    """Messages for one broker, filled from anywhere on the loop, emptied by one writer.

    Parameters
    ----------
    life
        Topic of the bridge's own state: of all retained messages it is sent last, for it vouches
        for the others.
    """

    def __init__(self, life: str) -> None:
        self.life = life
        self.dropped = 0
        """Messages that went without having been sent."""
        self._state: dict[str, bytes] = {}
        self._unsent: dict[str, None] = {}
        self._events: deque[Outgoing] = deque()
        self._streams: deque[Outgoing] = deque()
        self._wake = asyncio.Event()

    @property
    def queued(self) -> int:
        """Messages waiting."""
        return len(self._unsent) + len(self._events) + len(self._streams)

    @property
    def unsaid(self) -> bool:
        """Whether state or an event waits, or is on its way."""
        return bool(self._unsent or self._events)

    @property
    def retained(self) -> dict[str, bytes]:
        """Last value of every retained topic."""
        return dict(self._state)

    def retain(self, topic: str, payload: bytes) -> None:
        """Set the retained value of `topic`; an empty payload clears it at the broker."""
        if self._state.get(topic) != payload:
            self._state[topic] = payload
            self._unsent[topic] = None
            self._wake.set()

    def event(self, topic: str, payload: bytes, *, correlation: bytes | None = None) -> None:
        """Send once, at QoS 1."""
        message = Outgoing(topic, payload, 1, False, RESPONSE_EXPIRY_S, None, correlation)
        self._push(self._events, _EVENTS, message)

    def stream(self, topic: str, payload: bytes) -> None:
        """Send at QoS 0, or never."""
        self._push(self._streams, _STREAMS, Outgoing(topic, payload, 0, False, STREAM_EXPIRY_S))

    def _push(self, queue: deque[Outgoing], limit: int, message: Outgoing) -> None:
        if len(queue) >= limit:
            queue.popleft()
            self.dropped += 1
        queue.append(message)
        self._wake.set()

    def reconnected(self) -> None:
        """Send all state again, for the broker may have forgotten it; drop what is late."""
        self._unsent = dict.fromkeys(sorted(self._state, key=self.life.__eq__))
        self.dropped += len(self._streams)
        self._streams.clear()
        self._wake.set()

    async def next(self) -> tuple[Outgoing, Callable[[], None]]:
        """Wait for the next message; call what comes with it once it is sent."""
        while True:
            if self._unsent:
                return self._next_state()
            for queue in (self._events, self._streams):
                if queue:
                    return queue.popleft(), _done
            self._wake.clear()
            await self._wake.wait()

    def _next_state(self) -> tuple[Outgoing, Callable[[], None]]:
        topic = next(iter(self._unsent))
        payload = self._state[topic]

        def sent() -> None:
            if self._state.get(topic) is payload:  # else it changed meanwhile: once more
                self._unsent.pop(topic, None)
                if not payload:
                    del self._state[topic]

        return Outgoing(topic, payload, 1, True), sent


def _done() -> None:
    pass
