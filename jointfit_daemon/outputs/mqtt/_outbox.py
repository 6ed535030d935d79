"""Queue of messages that wait for publication.

Invariant: the size is limited, the oldest message is dropped first, and dropped messages are
counted.

There are five kinds of messages, which are sent in this order of priority. Responses come first,
because a client waits for them. State messages are retained: the last value of a topic replaces
earlier values, and all state is sent again on every connection. Events are sent in order. Stream
messages are useless when late. Late messages were stored by the spool during an outage of the
broker. The spool waits for their delivery. Responses, events and stream messages are dropped when
they have waited longer than their expiry time.

The outbox can send several messages before the first of them is acknowledged. After the connection
is lost, responses, events and late messages without an acknowledgement are sent again. They may
therefore arrive twice.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from functools import partial
from itertools import count
from typing import TYPE_CHECKING

from jointfit_daemon.outputs.mqtt._connection import Outgoing

if TYPE_CHECKING:
    from collections.abc import Callable

STREAM_EXPIRY_S = 2
"""Time after which the broker drops an undelivered stream message, s."""
RESPONSE_EXPIRY_S = 30
"""Time after which the broker drops an undelivered event or response, s."""

_STREAM_CAPACITY = 200
"""Largest number of waiting stream messages, equal to one to two seconds of poses and other
streams."""
_EVENT_CAPACITY = 256
"""Largest number of waiting events, equal to several minutes of a rig with faults."""

_Waiting = tuple[float, Outgoing]
"""Time at which a message expires (s, on the clock of the outbox), and the message."""


class Outbox:
    """Messages for one broker. Any code on the event loop adds messages; one task sends them.

    Parameters
    ----------
    state_topic
        Topic of the daemon's own state. On a new connection, this state is sent after all other
        retained messages, so that its subscribers can rely on the other messages.
    clock
        Function that returns monotonic time, s. It determines the expiry of waiting messages.
    """

    def __init__(self, state_topic: str, clock: Callable[[], float] = time.monotonic) -> None:
        self.state_topic = state_topic
        self.dropped = 0
        """Number of messages that were dropped before they were sent."""
        self._state: dict[str, bytes] = {}
        self._unsent: dict[str, None] = {}
        self._clock = clock
        self._responses: deque[_Waiting] = deque()
        self._events: deque[_Waiting] = deque()
        self._streams: deque[_Waiting] = deque()
        self._late: deque[_Waiting] = deque()
        self._unacknowledged: dict[int, tuple[deque[_Waiting], _Waiting] | None] = {}
        """Messages that are being sent, in order, each with the queue it came from; None for
        state."""
        self._numbers = count()
        self._wake = asyncio.Event()

    @property
    def queued(self) -> int:
        """Number of waiting messages."""
        queues = (self._responses, self._events, self._streams, self._late)
        return len(self._unsent) + sum(map(len, queues))

    @property
    def has_unsent(self) -> bool:
        """Whether a response, state or an event is waiting or being sent."""
        if self._responses or self._unsent or self._events:
            return True
        sending = self._unacknowledged.values()
        unimportant = (id(self._streams), id(self._late))
        return any(origin is None or id(origin[0]) not in unimportant for origin in sending)

    @property
    def late_waiting(self) -> int:
        """Number of late messages that the broker has not acknowledged."""
        sending = self._unacknowledged.values()
        return len(self._late) + sum(
            origin is not None and origin[0] is self._late for origin in sending
        )

    @property
    def is_empty(self) -> bool:
        """Whether no message is waiting or being sent."""
        return not self.queued and not self._unacknowledged

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

    def repeat(self, prefix: str) -> None:
        """Send again the retained values of all topics that begin with `prefix`."""
        self._unsent |= dict.fromkeys(topic for topic in self._state if topic.startswith(prefix))
        self._wake.set()

    def event(self, topic: str, payload: bytes) -> None:
        """Add a message that is sent at least once (QoS 1)."""
        message = Outgoing(topic, payload, 1, False, RESPONSE_EXPIRY_S)
        self._push(self._events, _EVENT_CAPACITY, message)

    def respond(self, topic: str, payload: bytes, *, correlation: bytes | None = None) -> None:
        """Add the response to a request. It is sent before all other messages, with QoS 1.

        `correlation` is the correlation data that the client sent with its request (MQTT 5).
        """
        message = Outgoing(topic, payload, 1, False, RESPONSE_EXPIRY_S, None, correlation)
        self._push(self._responses, _EVENT_CAPACITY, message)

    def stream(self, topic: str, payload: bytes, written: Callable[[], None] | None = None) -> None:
        """Add a message that is sent at most once (QoS 0); `written` is described at `Outgoing`."""
        message = Outgoing(topic, payload, 0, False, STREAM_EXPIRY_S, written=written)
        self._push(self._streams, _STREAM_CAPACITY, message)

    def late(self, topic: str, payload: bytes) -> None:
        """Add a message of an earlier outage, with QoS 1; the caller limits how many wait."""
        self._late.append((math.inf, Outgoing(topic, payload, 1, False)))
        self._wake.set()

    def _push(self, queue: deque[_Waiting], limit: int, message: Outgoing) -> None:
        if len(queue) >= limit:
            queue.popleft()
            self.dropped += 1
        queue.append((self._clock() + (message.expiry_s or 0), message))
        self._wake.set()

    def requeue_state(self) -> None:
        """Queue all state again, because the broker may have lost it, and drop stream messages.

        Responses, events and late messages without an acknowledgement are queued again as well.
        """
        for origin in reversed(self._unacknowledged.values()):
            if origin is not None:
                queue, waiting = origin
                queue.appendleft(waiting)
        self._unacknowledged.clear()

        self._unsent = dict.fromkeys(sorted(self._state, key=self.state_topic.__eq__))
        self.dropped += len(self._streams)
        self._streams.clear()
        self._wake.set()

    async def next(self) -> tuple[Outgoing, Callable[[], None]]:
        """Wait for the next message; return it with the function to call at its acknowledgement."""
        while True:
            if (waiting := self._take(self._responses)) is not None:
                return waiting[1], self._hand_out((self._responses, waiting))
            if self._unsent:
                return self._next_state()
            for queue in (self._events, self._streams, self._late):
                if (waiting := self._take(queue)) is not None:
                    return waiting[1], self._hand_out((queue, waiting))
            self._wake.clear()
            await self._wake.wait()

    def _take(self, queue: deque[_Waiting]) -> _Waiting | None:
        """Return the oldest message that has not expired; drop and count expired messages."""
        while queue:
            waiting = queue.popleft()
            if self._clock() <= waiting[0]:
                return waiting
            self.dropped += 1
        return None

    def _hand_out(self, origin: tuple[deque[_Waiting], _Waiting] | None) -> Callable[[], None]:
        """Store a message until it is acknowledged; return the function to call then."""
        number = next(self._numbers)
        self._unacknowledged[number] = origin
        return partial(self._acknowledge, number)

    def _acknowledge(self, number: int) -> None:
        self._unacknowledged.pop(number, None)

    def _next_state(self) -> tuple[Outgoing, Callable[[], None]]:
        topic = next(iter(self._unsent))
        del self._unsent[topic]
        payload = self._state[topic]
        acknowledge = self._hand_out(None)

        def acknowledged() -> None:
            acknowledge()
            if not payload and self._state.get(topic) is payload:
                del self._state[topic]

        return Outgoing(topic, payload, 1, True), acknowledged
