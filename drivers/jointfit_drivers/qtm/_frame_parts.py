"""Parts of one frame: over UDP a frame may arrive as several packets with the same number.

Invariant: pure. A frame is complete with every component that the settings announce, or when a
packet of another frame arrives. A component that never arrives is not waited for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jointfit_protocols.qtm import Component, DataFrame

_PATIENCE = 10
"""Consecutive frames without a component after which it is not expected any more."""


class CompleteFrame(NamedTuple):
    """One frame with all of its components."""

    arrival_ns: int
    """Arrival of its first packet."""
    timestamp_us: int
    number: int
    components: dict[int, Component]


class FrameParts:
    """Merges the packets of frames."""

    def __init__(self) -> None:
        self._expected: dict[int, int] = {}
        """Announced components, and the number of last frames without each."""
        self._pending: CompleteFrame | None = None

    @property
    def absent(self) -> tuple[int, ...]:
        """Announced components that do not arrive."""
        return tuple(kind for kind, missed in self._expected.items() if missed >= _PATIENCE)

    def expect(self, kinds: Iterable[int]) -> None:
        """Set the components of each frame; incomplete frames are dropped."""
        self._expected = dict.fromkeys(kinds, 0)
        self._pending = None

    def add(self, arrival_ns: int, packet: DataFrame) -> list[CompleteFrame]:
        """Return the frames that a packet completes, in order."""
        done = []
        pending, identity = self._pending, (packet.timestamp_us, packet.number)
        if pending is not None and (pending.timestamp_us, pending.number) != identity:
            done.append(self._count(pending))
            pending = None

        parts = {component.type: component for component in packet.components}
        if pending is None:
            pending = CompleteFrame(arrival_ns, *identity, parts)
        else:
            pending.components.update(parts)

        complete = all(
            kind in pending.components or missed >= _PATIENCE
            for kind, missed in self._expected.items()
        )
        self._pending = None if complete else pending
        return [*done, self._count(pending)] if complete else done

    def _count(self, frame: CompleteFrame) -> CompleteFrame:
        for kind, missed in self._expected.items():
            self._expected[kind] = 0 if kind in frame.components else missed + 1
        return frame
