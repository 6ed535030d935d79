"""Feeds recorded events to a fresh core: the same limb states come out, byte for byte.

Law: what the live shell did beyond moving events (opening ports, running the worker, storing) is
already in the events; a replay does none of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.model import LimbState
from jointfit_daemon.pipeline._core import Core

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from jointfit_daemon.pipeline.events import Event, Output


def replay(events: Iterable[Event]) -> Iterator[Output]:
    """Yield every output of the core over `events`, in order."""
    core = Core()
    for event in events:
        yield from core.feed(event)


def replay_states(events: Iterable[Event]) -> Iterator[LimbState]:
    """Yield only the limb states."""
    return (output for output in replay(events) if isinstance(output, LimbState))
