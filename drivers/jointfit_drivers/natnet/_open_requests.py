"""Which datagrams of a NatNet server are accepted: frames, and answers to open questions.

Invariant: pure; host times are arguments. UDP knows no connection, and a source address can be
forged. A SERVERINFO, MODELDEF, RESPONSE or ECHORESPONSE that answers no open question is dropped.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_protocols.natnet import (
    HEADER,
    Bare,
    Connect,
    EchoRequest,
    EchoResponse,
    MessageId,
    Request,
    decode,
)

if TYPE_CHECKING:
    from jointfit_protocols.natnet import Message

ANSWER_NS = 5_000_000_000
"""An answer that takes longer is dropped: as long as MODELDEF is waited for, ns."""
ECHO_NS = 1_000_000_000
"""An echo that takes longer says nothing about the clock, ns."""
OPEN_ECHOES = 32
"""Echo requests without an answer that are remembered; the burst at connection sends ten."""

_QUESTIONS = {
    MessageId.SERVERINFO: MessageId.CONNECT,
    MessageId.MODELDEF: MessageId.REQUEST_MODELDEF,
    MessageId.RESPONSE: MessageId.REQUEST,
}
_QUESTION_IDS: dict[type, MessageId] = {Connect: MessageId.CONNECT, Request: MessageId.REQUEST}


class OpenQuestions:
    """Questions to the server that are not answered yet."""

    def __init__(self) -> None:
        self._asked_ns: dict[MessageId, int] = {}
        self._echoes: dict[int, None] = {}
        self.unasked = 0
        """Messages dropped because they answered no open question."""

    def ask(self, message: Message, now_ns: int) -> None:
        """Take note of a message sent at `now_ns`; the stamp of an echo is its sending time."""
        if isinstance(message, EchoRequest):
            if len(self._echoes) >= OPEN_ECHOES:
                del self._echoes[next(iter(self._echoes))]
            self._echoes[message.stamp] = None
            return

        kind = message.id if isinstance(message, Bare) else _QUESTION_IDS.get(type(message))
        if kind is not None:
            self._asked_ns[kind] = now_ns

    def accept(self, datagram: bytes, now_ns: int) -> bool:
        """Return whether a control datagram answers an open question, or needs none.

        The first answer closes the question; one that was of no use makes the caller ask again.
        """
        kind = int.from_bytes(datagram[:2], "little") if len(datagram) >= HEADER.size else None
        if kind == MessageId.ECHORESPONSE:
            accepted = self._accept_echo(datagram, now_ns)
        elif kind in _QUESTIONS:
            asked_ns = self._asked_ns.pop(_QUESTIONS[MessageId(kind)], None)
            accepted = asked_ns is not None and now_ns - asked_ns <= ANSWER_NS
        else:
            accepted = True  # has no effect, whoever sent it; corrupt bytes are counted

        self.unasked += not accepted
        return accepted

    def _accept_echo(self, datagram: bytes, now_ns: int) -> bool:
        """Accept each stamp once: a duplicate with other ticks would bend the clock."""
        echo = decode(datagram, (0, 0))
        if not isinstance(echo, EchoResponse):
            return True  # malformed: counted as corrupt by the decoder
        known = echo.stamp in self._echoes
        self._echoes.pop(echo.stamp, None)
        return known and 0 <= now_ns - echo.stamp <= ECHO_NS
