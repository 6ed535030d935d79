"""Delivery of events and decimated poses after a broker outage, even if the daemon restarts.

While the daemon is connected, only the messages of the last seconds are stored, in memory. They are
needed because a loss of the connection is detected late, and messages that were sent before the
detection may not have arrived. During an outage, messages are written to disk. After the outage,
they are sent in order, at least once, after all other messages.

Invariant: `Spool.add` appends to a list of limited size and returns. Above a limit, the oldest
messages are dropped and counted.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Protocol, TypeVar

from jointfit_daemon.outputs.spool._spool_files import SpooledMessage, SpoolFiles

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.outputs.mqtt import Outbox

T = TypeVar("T")

BEFORE_S = 10.0
"""Largest age of the messages that are stored when the connection is lost, s. A loss without a
notification is detected within 8 s."""
START_S = 3.0
"""Time after the start during which a missing connection is not an outage, s."""
WRITE_S = 0.5
"""Interval between two writes during an outage, s. If the daemon is killed, the messages of one
interval are lost."""
SUBSCRIBE_S = 5.0
"""Time between a new connection and the start of the delivery, s. After a restart of the broker,
subscribers need this time to reconnect."""
MOST_PENDING = 2000
"""Largest number of messages that wait to be written to the disk."""
BATCH = 16
"""Largest number of messages that are being delivered at the same time."""
_POLL_S = 0.02
"""Interval between checks whether a batch was delivered, s."""


@dataclass(frozen=True, slots=True)
class SpoolHealth:
    """State of the spool; the payload of ``bridge/health`` contains these fields."""

    __pydantic_config__: ClassVar = {"extra": "forbid"}

    waiting: int
    """Number of messages that wait for the broker."""
    stored_bytes: int
    delivered: int
    """Number of messages that the broker has accepted since the daemon started."""
    dropped: int
    """Number of messages that were deleted because the spool was full."""
    damaged: int
    """Number of unreadable lines in the files."""
    failure: str | None
    """Reason why messages cannot be stored at present; None if there is no fault."""


class Link(Protocol):
    """State of the connection to a broker."""

    connected: bool
    connects: int
    """Number of times that the connection was established."""

    @property
    def outbox(self) -> Outbox:
        """Outbox of the connection, with the messages to publish."""

    @property
    def base(self) -> str:
        """Base topic."""


class Spool:
    """The spool of one rig.

    Parameters
    ----------
    files
        Files in which messages are stored.
    link
        Function that returns the connection to the current broker.
    """

    def __init__(self, files: SpoolFiles, link: Callable[[], Link]) -> None:
        self._files, self._link = files, link
        self._recent: deque[tuple[float, SpooledMessage]] = deque(maxlen=MOST_PENDING)
        self._pending: deque[SpooledMessage] = deque()
        self._using_files = asyncio.Lock()
        self._starting_until_s = time.monotonic() + START_S
        self._began = False
        """Whether a missing connection counts as an outage: the daemon was connected before, or has
        waited longer than `START_S`."""
        self._delivered = self._dropped = 0
        self._position = (0, 0)
        """Number of the file that is being delivered, and number of its messages that the broker
        accepted."""
        self._failure: str | None = None

    def add(self, topic: str, payload: bytes) -> None:
        """Store a message for delivery after an outage; `topic` is relative to the base topic."""
        now_s, message = time.monotonic(), SpooledMessage(topic, payload)
        if not self._link().connected:
            self._begin_outage(now_s)
            self._keep(message)
            return
        self._begin()
        self._recent.append((now_s, message))
        while self._recent[0][0] < now_s - BEFORE_S:
            self._recent.popleft()

    def _begin(self) -> None:
        """Discard the pending messages at the first connection; the outbox contains them, too."""
        if not self._began:
            self._began = True
            self._pending.clear()

    def _begin_outage(self, now_s: float) -> None:
        for sent_s, message in self._recent:
            if sent_s >= now_s - BEFORE_S:
                self._keep(message)
        self._recent.clear()

    def _keep(self, message: SpooledMessage) -> None:
        while len(self._pending) >= MOST_PENDING:
            self._pending.popleft()
            self._dropped += 1
        self._pending.append(message)

    def health(self) -> SpoolHealth:
        """Return the state of the spool."""
        return SpoolHealth(
            waiting=self._files.waiting + len(self._pending),
            stored_bytes=self._files.size_bytes,
            delivered=self._delivered,
            dropped=self._files.dropped + self._dropped,
            damaged=self._files.damaged,
            failure=self._failure,
        )

    async def run(self) -> None:
        """Write and deliver messages until cancelled.

        If the daemon is not connected at the cancellation, the remaining messages are written.
        """
        await self._with_files(self._files.load)
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(self._write_regularly(), name="spool writer")
                tasks.create_task(self._deliver_regularly(), name="spool delivery")
        finally:
            if not self._link().connected:
                self._begin_outage(time.monotonic())
                self._store_pending()

    async def _write_regularly(self) -> None:
        while True:
            now_s, connected = time.monotonic(), self._link().connected
            if connected:
                self._begin()
            elif self._began or now_s > self._starting_until_s:
                self._began = True
                self._begin_outage(now_s)
            if self._began and self._pending:
                await self._with_files(self._store_pending)
            await asyncio.sleep(WRITE_S)

    def _store_pending(self) -> None:
        """Write the waiting messages. Messages that the disk does not accept stay in the queue."""
        pending, self._pending = self._pending, deque()
        try:
            self._files.append(pending)
        except OSError as error:
            self._failure = f"{error.filename or 'spool'}: {error.strerror}"
            self._pending.extendleft(reversed(pending))
        else:
            self._failure = None

    async def _deliver_regularly(self) -> None:
        connection, since_s = 0, 0.0
        while True:
            link, now_s = self._link(), time.monotonic()
            if not link.connected or link.connects != connection:
                connection, since_s = link.connects, now_s
            elif now_s - since_s >= SUBSCRIBE_S and self._files.waiting:
                await self._deliver_file()
            await asyncio.sleep(WRITE_S)

    async def _deliver_file(self) -> None:
        """Send the oldest file, and delete it when the broker has accepted all its messages."""
        found = await self._with_files(self._files.oldest)
        if found is None:
            return
        number, messages = found
        done = self._position[1] if self._position[0] == number else 0
        link = self._link()
        for begin in range(done, len(messages), BATCH):
            batch = messages[begin : begin + BATCH]
            for topic, payload in batch:
                link.outbox.late(f"{link.base}/{topic}", payload)
            while link.outbox.late_waiting:
                if link is not self._link():  # another broker gets the whole batch
                    return
                await asyncio.sleep(_POLL_S)
            self._delivered += len(batch)
            self._position = (number, begin + len(batch))
        await self._with_files(lambda: self._files.remove(number))

    async def _with_files(self, work: Callable[[], T]) -> T | None:
        """Run `work` in a thread, one call at a time; store the reason if the disk fails."""
        async with self._using_files:
            running = asyncio.create_task(asyncio.to_thread(work), name="spool files")
            try:
                return await asyncio.shield(running)
            except OSError as error:
                self._failure = f"{error.filename or 'spool'}: {error.strerror}"
                return None
            finally:
                await asyncio.wait([running])
