"""Executes each request once, and answers its repetitions with the first answer.

A transaction is a text with which a client identifies its request. Invariant: every received
request gets one answer. A request with the same transaction as an earlier request is not executed.
The number of stored transactions and their storage time are limited.
"""

from __future__ import annotations

import logging
import time
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypeAlias

from jointfit_daemon.supervisor.requests._arguments import REQUESTS

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Awaitable, Callable, Mapping

    from jointfit_daemon.pipeline.events import Reply, ReplyAddress, Request

Handler: TypeAlias = "Callable[[Request], Awaitable[Reply | None]]"
"""Function that executes one request. It returns None if the core answers the request, or if the
function has already published the answer."""

log = logging.getLogger(__name__)

MEMORY_NS = 60_000_000_000
"""Time for which an answer is stored, ns. A broker repeats messages within seconds."""
MEMORY_CAPACITY = 256
"""Largest number of stored answers. A new answer replaces the oldest."""
MOST_RUNNING = 16
"""Largest number of requests that wait for their answers."""


@dataclass(slots=True)
class _Transaction:
    """One request with a transaction, and its answer."""

    request: Request
    reply: Reply | None = None
    """Answer to the request; None until the request is answered."""
    repeated: list[ReplyAddress] = field(default_factory=list)
    """Reply addresses of repetitions that wait for the answer."""


class RequestDispatcher:
    """Passes requests to the core or to the daemon's handlers.

    Parameters
    ----------
    tasks : asyncio.TaskGroup
        Task group that owns the task of every handler.
    feed
        Function that passes a request to the core. The core answers at once by one of its outputs.
    publish
        Function that publishes one answer.
    handlers
        Handlers by the name of the request. The core processes all other requests of `REQUESTS`.

    Raises
    ------
    ValueError
        A handler has a name that is not a request.
    """

    def __init__(
        self,
        tasks: asyncio.TaskGroup,
        feed: Callable[[Request], None],
        publish: Callable[[Reply], None],
        handlers: Mapping[str, Handler],
    ) -> None:
        if unknown := handlers.keys() - REQUESTS.keys():
            raise ValueError(f"handlers without a request: {', '.join(sorted(unknown))}")
        self._tasks, self._feed, self._publish = tasks, feed, publish
        self._handlers = handlers
        self._running = 0
        self._known: OrderedDict[str, _Transaction] = OrderedDict()

    def receive(self, request: Request) -> None:
        """Execute a request; if it is a repetition, answer it with the stored answer."""
        if request.transaction and self._is_repeated(request):
            return
        handler = self._handlers.get(request.command)
        if handler is None:
            self._feed(request)
        elif self._running >= MOST_RUNNING:
            text = f"{MOST_RUNNING} requests are waiting for their answers: send it again later"
            reply = request.refusal("command", text)
            self._publish(reply)
            self.note_reply(reply)
        else:
            self._running += 1
            name = f"request {request.command}"
            self._tasks.create_task(self._run(handler, request), name=name)

    def note_reply(self, reply: Reply) -> None:
        """Store a published answer, and publish it also for the repetitions that wait for it."""
        known = self._known.get(reply.transaction)
        if known is None or known.reply is not None or known.request.command != reply.command:
            return
        known.reply = reply
        for address in known.repeated:
            self._publish(replace(reply, reply_to=address))

    def _is_repeated(self, request: Request) -> bool:
        """Answer a request with a known transaction and return True; else store the transaction."""
        now_ns = time.monotonic_ns()
        while self._known and (
            len(self._known) >= MEMORY_CAPACITY
            or now_ns - next(iter(self._known.values())).request.t_ns > MEMORY_NS
        ):
            self._known.popitem(last=False)

        known = self._known.get(request.transaction)
        if known is None:
            self._known[request.transaction] = _Transaction(request)
            return False

        first = known.request
        if (first.command, first.arguments) != (request.command, request.arguments):
            text = (
                f"{request.transaction!r} belongs to another request of the last "
                f"{MEMORY_NS // 10**9} s: use a new text for every request"
            )
            self._publish(request.refusal("transaction", text))
        elif known.reply is None:
            known.repeated.append(request.reply_to)
        else:
            self._publish(replace(known.reply, reply_to=request.reply_to))
        return True

    async def _run(self, handler: Handler, request: Request) -> None:
        try:
            reply = await handler(request)
        except Exception as error:
            log.exception("request %s", request.command)
            text = f"failed because of a bug, please report it: {error!r}"
            reply = request.refusal("command", text)
        finally:
            self._running -= 1
        if reply is not None:
            self._publish(reply)
            self.note_reply(reply)
