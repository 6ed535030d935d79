"""Chunks of a server, and whether its frames have stopped."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit
    from jointfit_daemon.model import Chunk


class ServerOutput:
    """Emits what a server sends, from one connection of a driver to the next.

    After a silence, or a connection with answers but without a frame, answers are emitted with
    the first frame: a server that only answers is no source of data, and is reported once.
    """

    def __init__(self) -> None:
        self.silent = False
        """Whether frames have stopped and none has arrived since, in any connection."""
        self._answered = self._framed = False
        self._held: list[Chunk] = []

    def begin(self, emit: Emit) -> None:
        """Begin a connection, whose chunks `emit` receives."""
        self._emit = emit
        self.silent |= self._answered and not self._framed
        self._answered = self._framed = False
        self._held.clear()

    def emit_frame(self, chunk: Chunk) -> None:
        """Emit a chunk with a frame, after the answers before it."""
        self.silent, self._framed = False, True
        for held in self._held:
            self._emit(held)
        self._held.clear()
        self._emit(chunk)

    def emit_answer(self, chunk: Chunk) -> None:
        """Emit a chunk without frames; after a silence, with the first frame."""
        self._answered = True
        if self.silent:
            self._held.append(chunk)
        else:
            self._emit(chunk)
