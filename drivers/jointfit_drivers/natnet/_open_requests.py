"""Requests to a NatNet server that wait for an answer; they decide which datagrams are accepted.

UDP has no connections, and source addresses can be forged. A SERVERINFO, MODELDEF, RESPONSE or
ECHORESPONSE is therefore dropped unless it answers an open request.

Invariant: the module is pure. Host times are passed as arguments.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_protocols.natnet import (
    HEADER,
    Bare,
    CommandRequest,
    Connect,
    EchoRequest,
    EchoResponse,
    NatNetMessageId,
    decode,
)

if TYPE_CHECKING:
    from jointfit_protocols.natnet import Message

ANSWER_NS = 5_000_000_000
"""Age of a request above which its answer is dropped, ns; equal to the longest wait for
MODELDEF."""
ECHO_NS = 1_000_000_000
"""Age of an echo request above which its answer is not used for the clock, ns."""
OPEN_ECHOES = 32
"""Largest number of stored echo requests without answer. A connection begins with ten requests."""

_REQUEST_OF_ANSWER = {
    NatNetMessageId.SERVERINFO: NatNetMessageId.CONNECT,
    NatNetMessageId.MODELDEF: NatNetMessageId.REQUEST_MODELDEF,
    NatNetMessageId.RESPONSE: NatNetMessageId.REQUEST,
}
_REQUEST_IDS: dict[type, NatNetMessageId] = {
    Connect: NatNetMessageId.CONNECT,
    CommandRequest: NatNetMessageId.REQUEST,
}


class OpenRequests:
    """Requests to the server that have no answer yet."""

    def __init__(self) -> None:
        self._asked_ns: dict[NatNetMessageId, int] = {}
        self._echoes: dict[int, None] = {}
        self.unsolicited = 0
        """Number of messages dropped because they answered no open request."""

    def register(self, message: Message, now_ns: int) -> None:
        """Register a message that was sent at `now_ns`.

        An echo request contains its own sending time, so `now_ns` is not used.
        """
        if isinstance(message, EchoRequest):
            if len(self._echoes) >= OPEN_ECHOES:
                del self._echoes[next(iter(self._echoes))]
            self._echoes[message.stamp] = None
            return

        kind = message.id if isinstance(message, Bare) else _REQUEST_IDS.get(type(message))
        if kind is not None:
            self._asked_ns[kind] = now_ns

    def accept(self, datagram: bytes, now_ns: int) -> bool:
        """Return whether a control datagram answers an open request, or needs no request.

        The first answer closes the request. If the answer is unusable, the caller sends a new
        request.
        """
        kind = int.from_bytes(datagram[:2], "little") if len(datagram) >= HEADER.size else None
        if kind == NatNetMessageId.ECHORESPONSE:
            # Each stamp is accepted only once, because a duplicate with other ticks would distort
            # the clock.
            echo = decode(datagram, (0, 0))
            accepted = True  # malformed; the decoder counts it as corrupt
            if isinstance(echo, EchoResponse):
                known = echo.stamp in self._echoes
                self._echoes.pop(echo.stamp, None)
                accepted = known and 0 <= now_ns - echo.stamp <= ECHO_NS
        elif kind in _REQUEST_OF_ANSWER:
            asked_ns = self._asked_ns.pop(_REQUEST_OF_ANSWER[NatNetMessageId(kind)], None)
            accepted = asked_ns is not None and now_ns - asked_ns <= ANSWER_NS
        else:
            accepted = True  # the message has no effect, but the decoder counts corrupt bytes

        self.unsolicited += not accepted
        return accepted
