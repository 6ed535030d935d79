"""Interface of the components that receive the input events and the outputs of the core.

The supervisor creates and subscribes the sinks that rig.toml requests.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from jointfit_daemon.pipeline.events import Event, Output


class Sink(Protocol):
    """A subscriber of the core: a recorder, a publisher or an exporter of metrics.

    Both methods run on the event loop and return at once: slow work belongs to a task or thread.
    """

    def event(self, event: Event) -> None:
        """Receive one input event before the core processes it."""

    def output(self, output: Output) -> None:
        """Receive one output of the core."""
