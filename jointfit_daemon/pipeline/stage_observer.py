"""Interface with which a core reports that an event has passed a stage of processing.

Invariant: a core receives no data from its observer, so the outputs are the same as without an
observer.
"""

from __future__ import annotations

from typing import Protocol


class StageObserver(Protocol):
    """Observer of the stages of a frame, for example with a clock, which a core does not have."""

    def mark_decoded(self, arrival_ns: int) -> None:
        """Process the report that a chunk was decoded and its measurements were stamped.

        Parameters
        ----------
        arrival_ns
            Arrival of the chunk, CLOCK_MONOTONIC ns.
        """

    def mark_aligned(self) -> None:
        """Process the report that the aligner released one or more frames."""

    def mark_fused(self, deadline_ns: int | None) -> None:
        """Process the report that the limb state of the next released frame was computed.

        Parameters
        ----------
        deadline_ns
            Deadline at which the frame was released, CLOCK_MONOTONIC ns; None if the chunk that was
            decoded last completed it.
        """
