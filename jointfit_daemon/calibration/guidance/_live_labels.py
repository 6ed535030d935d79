"""Detection of exchanged marker labels during a movement, frame by frame."""

from __future__ import annotations

from collections import Counter, deque
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.limb_model import LabelExamination, LabelFault, LabelSearch

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.limb_model import MarkerCluster
    from jointfit_daemon.model import MocapFrame, MocapLayout

_INTERVAL = 24
"""Number of frames from one examined frame to the next. The search takes milliseconds and is
divided among the frames that follow.
"""
_RECENT = 12
"""Number of examined frames on which a decision is based: 2 to 3 s at 100 to 120 Hz."""
_CONFIRMED = 0.6
"""Smallest fraction of the examined frames that a fault must explain."""


class LiveLabels:
    """Labels of all body parts relative to the static pose.

    Parameters
    ----------
    clusters : mapping of str to MarkerCluster
        Body parts in the static pose, by name.
    """

    def __init__(self, clusters: Mapping[str, MarkerCluster]) -> None:
        self._search = LabelSearch(clusters.values())
        self._frames = 0
        self._examination: LabelExamination | None = None
        self._recent: deque[tuple[LabelFault, ...]] = deque(maxlen=_RECENT)
        self._layout: MocapLayout | None = None
        self._columns: list[int] = []

    def feed(self, frame: MocapFrame) -> None:
        """Start to examine the frame, or continue the examination of an earlier frame."""
        self._frames += 1
        if self._frames % _INTERVAL == 0:
            if frame.layout is not self._layout:
                self._layout = frame.layout
                column = {name: k for k, name in enumerate(frame.layout.markers)}
                self._columns = [column.get(name, -1) for name in self._search.labels]
            padded = np.concatenate((frame.markers, np.full((1, 3), np.nan)))
            # Both timestamps are 0, so that `advance` does one part of the search per frame.
            self._examination = LabelExamination(self._search, 0, padded[self._columns])

        finding = None if self._examination is None else self._examination.advance(0)
        if finding is not None:
            self._recent.append(finding.faults)
            self._examination = None

    def exchanges(self) -> list[LabelFault]:
        """Return the exchanges that explain most of the last frames."""
        if len(self._recent) < _RECENT:
            return []
        votes = Counter(fault for faults in self._recent for fault in faults)
        least = _CONFIRMED * _RECENT
        return [fault for fault in votes if votes[fault] >= least and len(fault.markers) > 1]
