"""Output of a server's chunks, and detection that its frames have stopped."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit
    from jointfit_daemon.model import Chunk


class ServerOutput:
    """Emits the chunks of a server, across all connections of a driver.

    An answer is a chunk without a frame. If the frames have stopped, or if the previous connection
    received answers but no frame, answers are emitted only with the next frame. Otherwise a server
    that sends only answers would be reported as lost again at every connection.
    """

    def __init__(self) -> None:
        self.silent = False
        """Whether frames have stopped, or the previous connection received answers but no frame.
        The next frame ends this state."""
        self._answered = self._framed = False
        self._held: list[Chunk] = []

    def begin(self, emit: Emit) -> None:
        """Begin a connection whose chunks are passed to `emit`."""
        self._emit = emit
        self.silent |= self._answered and not self._framed
        self._answered = self._framed = False
        self._held.clear()

    def emit_frame(self, chunk: Chunk) -> None:
        """Emit a chunk that contains a frame, after the answers that arrived before it."""
        self.silent, self._framed = False, True
        for held in self._held:
            self._emit(held)
        self._held.clear()
        self._emit(chunk)

    def emit_answer(self, chunk: Chunk) -> None:
        """Emit a chunk without frames. If frames have stopped, emit it with the next frame."""
        self._answered = True
        if self.silent:
            self._held.append(chunk)
        else:
            self._emit(chunk)
