"""Search for exchanged labels in one frame, spread over the following frames.

Invariant: the result equals the result of `LabelSearch.explain`, for any frames during the search.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model._label_search import LabelFinding, LabelSearch

_PART_NS = 20_000_000
"""Time in which an examination does one part, ns: at 100 Hz one part per frame."""
_MOST_PARTS = 4
"""Largest number of parts in one frame."""


class LabelExamination:
    """Search in one frame, spread over the frames after it.

    Parameters
    ----------
    search : LabelSearch
        The clusters.
    t_ns : int
        Instant of the frame.
    points : ndarray, shape (M, 3)
        Markers in the order of its labels, m; NaN if hidden.
    """

    def __init__(self, search: LabelSearch, t_ns: int, points: Array) -> None:
        self.t_ns = t_ns
        self._last_ns = t_ns
        self._parts = search.parts(points)

    def advance(self, t_ns: int) -> LabelFinding | None:
        """Do the next parts of the search in a frame, and return the result of the last part.

        The number of parts depends on the time since the preceding frame, because some cameras are
        slow.
        """
        count = min(1 + (t_ns - self._last_ns) // _PART_NS, _MOST_PARTS)
        self._last_ns = t_ns
        try:
            for _ in range(count):
                next(self._parts)
        except StopIteration as end:
            finding: LabelFinding = end.value
            return finding
        return None
