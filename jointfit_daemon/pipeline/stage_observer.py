"""Interface through which a core reports that an event has passed a processing stage.

Invariant: a core receives no data from its observer, so the observer does not affect the outputs.
"""

from __future__ import annotations

from typing import Protocol


class StageObserver(Protocol):
    """Observer of the processing stages of a frame. It may use a clock; a core must not."""

    def mark_decoded(self, arrival_ns: int) -> None:
        """Record that a chunk was decoded and its measurements were stamped.

        Parameters
        ----------
        arrival_ns
            Arrival of the chunk, CLOCK_MONOTONIC ns.
        """

    def mark_aligned(self) -> None:
        """Record that the aligner released one or more frames."""

    def mark_fused(self, deadline_ns: int | None) -> None:
        """Record that the limb state of the next released frame was computed.

        Parameters
        ----------
        deadline_ns
            Deadline at which the frame was released, CLOCK_MONOTONIC ns. None means that the most
            recently decoded chunk completed the frame.
        """
