"""Replay of recorded events in a new core: gives the limb states of the live run, byte for byte.

Opening of ports, calibration jobs and storage are not repeated: the recorded events contain their
results.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.model import LimbState
from jointfit_daemon.pipeline._core import Core

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from jointfit_daemon.pipeline.events import Event, Output


def replay(events: Iterable[Event]) -> Iterator[Output]:
    """Yield all outputs of a new core for `events`, in order."""
    core = Core()
    for event in events:
        yield from core.feed(event)


def replay_states(events: Iterable[Event]) -> Iterator[LimbState]:
    """Yield the limb states of a new core for `events`, in order."""
    return (output for output in replay(events) if isinstance(output, LimbState))
