"""Search for exchanged labels in one frame, with the computation spread over later frames.

Invariant: the result equals the result of `LabelSearch.explain`. Frames that arrive during the
search do not change it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model._label_search import LabelFinding, LabelSearch

_PART_NS = 20_000_000
"""Time since the preceding frame for which one additional part is done, ns. A stream at 100 Hz has
one part per frame.
"""
_MOST_PARTS = 4
"""Largest number of parts in one frame."""


class LabelExamination:
    """Search for exchanged labels in one frame, done in parts when later frames arrive.

    Parameters
    ----------
    search : LabelSearch
        Search with the clusters.
    t_ns : int
        Instant of the frame.
    points : ndarray, shape (M, 3)
        Marker positions in the order of the labels of `search`, m; NaN if hidden.
    """

    def __init__(self, search: LabelSearch, t_ns: int, points: Array) -> None:
        self.t_ns = t_ns
        self._last_ns = t_ns
        self._parts = search.parts(points)

    def advance(self, t_ns: int) -> LabelFinding | None:
        """Do the next parts of the search; return the result after the last part, else None.

        The number of parts increases with the time since the preceding frame, so that the search
        with slow cameras does not take longer.
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
