"""Chunks of a server, and whether its frames have stopped."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit
    from jointfit_daemon.model import Chunk


class ServerOutput:
    """Emits what a server sends, from one connection of a driver to the next.

    After a silence, answers are emitted with the first frame, because a server that only answers is
    still lost.
    """

    def __init__(self) -> None:
        self.silent = False
        """Whether frames have stopped and none has arrived since, in any connection."""
        self._held: list[Chunk] = []

    def begin(self, emit: Emit) -> None:
        """Begin a connection, whose chunks `emit` receives."""
        self._emit = emit
        self._held.clear()

    def emit_frame(self, chunk: Chunk) -> None:
        """Emit a chunk with a frame, after the answers before it."""
        self.silent = False
        for held in self._held:
            self._emit(held)
        self._held.clear()
        self._emit(chunk)

    def emit_answer(self, chunk: Chunk) -> None:
        """Emit a chunk without frames; after a silence, with the first frame."""
        if self.silent:
            self._held.append(chunk)
        else:
            self._emit(chunk)
