"""Messages waiting for publication.

Invariant: the size is limited, the oldest message is dropped first, and drops are counted.

Three kinds wait separately. State is retained: the last value of a topic replaces earlier ones, and
all state is sent again on every connection. Events are sent once, in order. Stream messages are
useless when late.
"""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING

from jointfit_daemon.outputs.mqtt._connection import Outgoing

if TYPE_CHECKING:
    from collections.abc import Callable

STREAM_EXPIRY_S = 2
"""Time after which the broker drops an undelivered stream message, s."""
RESPONSE_EXPIRY_S = 30
"""Time after which the broker drops an undelivered event or response, s."""

_STREAM_CAPACITY = 200
"""Stream messages that may wait: one to two seconds of poses and other streams."""
_EVENT_CAPACITY = 256
"""Events that may wait: several minutes of a rig with faults."""


class Outbox:
    """Messages for one broker, filled by any code on the event loop, emptied by one writer.

    Parameters
    ----------
    state_topic
        Topic of the daemon's own state. On a new connection it is sent after all other retained
        messages, so that a subscriber of it can rely on them.
    """

    def __init__(self, state_topic: str) -> None:
        self.state_topic = state_topic
        self.dropped = 0
        """Messages dropped without having been sent."""
        self._state: dict[str, bytes] = {}
        self._unsent: dict[str, None] = {}
        self._events: deque[Outgoing] = deque()
        self._streams: deque[Outgoing] = deque()
        self._wake = asyncio.Event()

    @property
    def queued(self) -> int:
        """Number of waiting messages."""
        return len(self._unsent) + len(self._events) + len(self._streams)

    @property
    def has_unsent(self) -> bool:
        """Whether state or an event is waiting, or is being sent."""
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
        """Queue a message that is sent once, at QoS 1."""
        message = Outgoing(topic, payload, 1, False, RESPONSE_EXPIRY_S, None, correlation)
        self._push(self._events, _EVENT_CAPACITY, message)

    def stream(self, topic: str, payload: bytes) -> None:
        """Queue a message that is sent at most once, at QoS 0."""
        message = Outgoing(topic, payload, 0, False, STREAM_EXPIRY_S)
        self._push(self._streams, _STREAM_CAPACITY, message)

    def _push(self, queue: deque[Outgoing], limit: int, message: Outgoing) -> None:
        if len(queue) >= limit:
            queue.popleft()
            self.dropped += 1
        queue.append(message)
        self._wake.set()

    def reconnected(self) -> None:
        """Queue all state again, since the broker may have lost it; drop waiting streams."""
        self._unsent = dict.fromkeys(sorted(self._state, key=self.state_topic.__eq__))
        self.dropped += len(self._streams)
        self._streams.clear()
        self._wake.set()

    async def next(self) -> tuple[Outgoing, Callable[[], None]]:
        """Wait for the next message; return it with a callback for the moment it was sent."""
        while True:
            if self._unsent:
                return self._next_state()
            for queue in (self._events, self._streams):
                if queue:
                    return queue.popleft(), lambda: None
            self._wake.clear()
            await self._wake.wait()

    def _next_state(self) -> tuple[Outgoing, Callable[[], None]]:
        topic = next(iter(self._unsent))
        payload = self._state[topic]

        def sent() -> None:
            if self._state.get(topic) is payload:  # otherwise a newer value waits
                self._unsent.pop(topic, None)
                if not payload:
                    del self._state[topic]

        return Outgoing(topic, payload, 1, True), sent
