"""Parts of one frame: over UDP, a frame may arrive as several packets with the same number.

Invariant: the module is pure. A frame is complete when it has every component that the settings
announce, or when a packet of another frame arrives. If a component is missing in `_PATIENCE`
consecutive frames, frames no longer wait for it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jointfit_protocols.qtm import Component, DataFrame

_PATIENCE = 10
"""Number of consecutive frames without a component after which it is no longer expected."""


class CompleteFrame(NamedTuple):
    """One frame with all of its received components."""

    arrival_ns: int
    """Arrival of the frame's first packet, ns."""
    timestamp_us: int
    number: int
    components: dict[int, Component]


class FrameParts:
    """Merges the packets of each frame."""

    def __init__(self) -> None:
        self._expected: dict[int, int] = {}
        """Announced components, each with the number of consecutive frames without it."""
        self._pending: CompleteFrame | None = None

    @property
    def absent(self) -> tuple[int, ...]:
        """Announced components that do not arrive."""
        return tuple(kind for kind, missed in self._expected.items() if missed >= _PATIENCE)

    def expect(self, kinds: Iterable[int]) -> None:
        """Set the components that each frame must have, and drop incomplete frames."""
        self._expected = dict.fromkeys(kinds, 0)
        self._pending = None

    def add(self, arrival_ns: int, packet: DataFrame) -> list[CompleteFrame]:
        """Return the frames that a packet completes, in the order of arrival."""
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
