"""Interface of the components that receive the input events and the outputs of the core.

The supervisor creates the sinks that rig.toml requests, and connects them to the core.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from jointfit_daemon.pipeline.events import Event, Output


class Sink(Protocol):
    """A consumer of the core's events and outputs: a recorder, publisher or metrics exporter.

    Both methods run on the event loop and return at once. Slow work must run in a task or a thread.
    """

    def event(self, event: Event) -> None:
        """Receive one input event before the core processes it."""

    def output(self, output: Output) -> None:
        """Receive one output of the core."""
