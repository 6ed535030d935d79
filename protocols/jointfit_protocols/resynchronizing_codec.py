"""Search of a byte stream for messages whose start, length or checksum may be corrupt.

A possible message is a candidate until its checksum is correct. A valid message may begin inside a
corrupt candidate. After a corrupt candidate, the search therefore continues at its second byte.

Invariant: the result does not depend on the boundaries of the byte strings that are fed. Every byte
belongs to one message or to one run of corrupt bytes. At most one incomplete candidate is stored,
so the memory is limited by the largest message that a protocol accepts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from jointfit_protocols.compilation import mypyc_attr
from jointfit_protocols.corrupt import CHECKSUM, CUT_OFF, NO_START, CorruptBytes, CorruptRun

if TYPE_CHECKING:
    import re
    from collections.abc import Callable


class StreamMessage(Protocol):
    """Interface of a message in a byte stream."""

    @property
    def end(self) -> int:
        """Number of bytes fed to the codec until the end of the message."""


M = TypeVar("M", bound=StreamMessage)


@mypyc_attr(allow_interpreted_subclasses=True)  # for driver packages of other authors
class ResynchronizingCodec(Generic[M]):
    """Codec that converts byte strings of any size to messages.

    A run of bytes without a message becomes one `CorruptBytes`. It is returned before the message
    that ends the run, at `flush`, or after `longest_run` bytes.

    Parameters
    ----------
    read : callable
        Function that returns the message that begins at an index of a buffer, or None if the
        message is incomplete. If there is no message, it returns the number of bytes to skip and
        the reason. Its third argument is the number of bytes fed before the buffer.
    start : re.Pattern
        Pattern that matches wherever `read` does not return the reason `no_start`.
    longest_run : int
        Number of bytes without a message after which they are reported.
    no_start : str
        Reason for bytes outside of all candidates.
    shortest : int
        Smallest number of bytes that can contain a message.
    """

    def __init__(
        self,
        read: Callable[[bytes, int, int], M | CorruptBytes | None],
        start: re.Pattern[bytes],
        longest_run: int,
        no_start: str = NO_START,
        shortest: int = 1,
    ) -> None:
        self._read = read
        self._start = start
        self._no_start = no_start
        self._shortest = shortest
        self._run = CorruptRun(longest_run, no_start)
        self._pending = b""  # less than one message between calls
        self.fed = 0
        """Number of bytes fed so far."""
        self.messages = 0
        """Number of messages so far."""
        self.checksum_failures = 0
        """Number of complete candidates with a wrong checksum so far."""

    @property
    def pending(self) -> int:
        """Number of bytes of the incomplete message in the buffer."""
        return len(self._pending)

    @property
    def discarded(self) -> int:
        """Number of bytes so far that belong to no message."""
        return self._run.discarded

    def feed(self, data: bytes) -> list[M | CorruptBytes]:
        """Return the messages that `data` completes, in wire order; never raise."""
        if not data:
            return []
        buffer = self._pending + data
        end = len(buffer)
        self.fed += len(data)
        base = self.fed - end
        item = self._read(buffer, 0, base)
        if (  # usually `data` is exactly one message
            item is not None
            and type(item) is not CorruptBytes
            and item.end == self.fed
            and not self._run.count
        ):
            self._pending = b""
            self.messages += 1
            return [item]

        found: list[M | CorruptBytes] = []
        at = 0
        while item is not None:
            if type(item) is CorruptBytes:  # takes half the time of isinstance()
                at += self._skip(buffer, at, item, found)
            else:
                if self._run.count:
                    self._run.end(found)
                found.append(item)
                self.messages += 1
                at = item.end - base
            if at == end:
                break
            item = self._read(buffer, at, base)
        self._pending = buffer[at:]
        return found

    def flush(self) -> list[M | CorruptBytes]:
        """Discard an incomplete message; return messages that the other pending bytes contain."""
        found: list[M | CorruptBytes] = []
        while self._pending:
            # The pending bytes begin with an incomplete candidate. The search continues after its
            # first byte.
            count = len(self._pending) if len(self._pending) < self._shortest else 1
            self._run.add(count, CUT_OFF, found)
            rest, self._pending = self._pending[count:], b""
            self.fed -= len(rest)
            found += self.feed(rest)
        self._run.end(found)
        return found

    def _skip(
        self, buffer: bytes, at: int, fault: CorruptBytes, found: list[M | CorruptBytes]
    ) -> int:
        """Add the bytes without a message at `at` to the run, and return their number."""
        count, reason = fault
        if reason == self._no_start:
            start = self._start.search(buffer, at + 1)
            count = (len(buffer) if start is None else start.start()) - at
        elif reason == CHECKSUM:
            self.checksum_failures += 1
        self._run.add(count, reason, found)
        return count
