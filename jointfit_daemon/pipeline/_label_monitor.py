"""Detection of exchanged, mislabelled and displaced markers from the shapes of marker clusters.

The monitor is used for rigs without a chain model. It compares the markers with the marker clusters
of the current calibration. A cluster is the arrangement of the markers on one body part. Markers
fit a cluster if their RMS residual is at most `MAX_FIT_RMS_M`. Markers with faulty labels are
hidden from fusion until they fit the clusters again. Invariant: a fault is reported when it has
explained most frames of 2 s. Its end is reported after 2 s without this fault. Hidden markers
neither begin nor end a fault.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping  # noqa: TC003 - mypyc evaluates the types of fields
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.limb_model import (
    MAX_FIT_RMS_M,
    LabelExamination,
    LabelFault,
    LabelSearch,
    body_parts,
    joint_parts,
    restore_cluster,
)
from jointfit_daemon.model import MarkerFlag
from jointfit_daemon.name_lists import join_words
from jointfit_daemon.pipeline.events import Notice, NoticeKind, NoticeLevel
from jointfit_daemon.timing.alignment import RateDivider

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import Chain, MocapFrame, MocapLayout, Vector
    from jointfit_daemon.pipeline.events import Output

RATE_HZ = 5.0
"""Rate of examined frames, Hz. A search takes milliseconds, so it is distributed over several
frames."""
FAULT_NS = 2_000_000_000
"""Time for which a fault must be present or absent before its begin or end is reported, ns."""
MISFIT_NS = 4_000_000_000
"""Time after which a cluster is reported if no exchange of labels explains its misfit, ns."""
_FEWEST = 7
"""Smallest number of frames for a decision. All clusters of the fault are visible in these frames.
At `RATE_HZ`, they span more than half of `FAULT_NS`."""
_PRESENT = 0.6
"""Smallest share of frames that a fault must explain to begin. Markers may be hidden in the other
frames."""
_ABSENT = 0.1
"""Largest share of frames in which a fault or misfit may still occur when its end is reported."""
_REFUSED = 0.8
"""A misfit of a body part is reported if the markers of the part do not fit its cluster in at least
this share of the frames in which enough of the markers are visible."""


class _Examined(NamedTuple):
    """Result of the examination of one frame."""

    t_ns: int
    fitted: frozenset[str]
    """Body parts of which enough markers are visible to determine a pose."""
    refused: Mapping[str, float]
    """RMS residuals of the body parts whose markers do not fit, m."""
    faults: frozenset[LabelFault]


class LabelMonitor:
    """Monitors the marker labels of a calibrated limb.

    Parameters
    ----------
    chain : Chain
        The limb.
    calibration : Calibration
        Marker clusters and joint centers in use.
    """

    def __init__(self, chain: Chain, calibration: Calibration) -> None:
        self._given = chain, dict(calibration.clusters), _centers(chain, calibration)
        self._search = LabelSearch(
            (restore_cluster(name, stored) for name, stored in calibration.clusters.items()),
            {parts: np.array(center) for parts, center in self._given[2].items()},
        )
        self._rate = RateDivider(RATE_HZ)
        self._examination: LabelExamination | None = None
        self._examined: deque[_Examined] = deque()
        self._layout: MocapLayout | None = None
        self._columns: list[int] = []
        self._hidden: NDArray[np.intp] = np.zeros(0, dtype=np.intp)
        """Columns of the mocap layout whose labels are faulty."""
        self.faults: dict[LabelFault, frozenset[str]] = {}
        """Current faults, each with the body parts that must be visible before the end of the fault
        is reported."""
        self.misfits: frozenset[str] = frozenset()
        """Body parts whose markers do not fit for a reason that no fault in `faults` explains."""

    def serves(self, chain: Chain, calibration: Calibration) -> bool:
        """Return whether a new monitor with these arguments would be equivalent to this monitor."""
        given = chain, dict(calibration.clusters), _centers(chain, calibration)
        return self._given == given

    def reset(self) -> None:
        """Discard all frames and faults, for example because markers are being placed again."""
        self._examination = None
        self._examined.clear()
        self.faults, self.misfits = {}, frozenset()
        self._hidden = self._hidden[:0]

    def hide_faulty(self, frame: MocapFrame) -> MocapFrame:
        """Return a frame without the markers whose labels are faulty."""
        if not self._hidden.size or frame.layout is not self._layout:
            return frame
        markers = frame.markers.copy()
        markers[self._hidden] = np.nan
        return replace(frame, markers=markers)

    def add_frame(self, t_ns: int, frame: MocapFrame) -> list[Output]:
        """Examine a live frame if it is due, or continue with an earlier frame; return notices."""
        if not self._search.clusters:
            return []
        if frame.layout is not self._layout:
            self._layout = frame.layout
            column = {name: k for k, name in enumerate(frame.layout.markers)}
            self._columns = [column.get(name, -1) for name in self._search.labels]
            self._hide()
        if self._examination is None:
            if not self._rate.is_due(t_ns):
                return []
            # Collect the M markers of the clusters in a frame, m, shape (M, 3); NaN where missing.
            padded = np.concatenate((frame.markers, np.full((1, 3), np.nan)))
            points = padded[self._columns]
            self._examination = LabelExamination(self._search, t_ns, points)

        finding = self._examination.advance(t_ns)
        if finding is None:
            return []
        t_ns, (rms, faults) = self._examination.t_ns, finding
        self._examination = None
        named = dict(zip((one.name for one in self._search.clusters), rms.tolist(), strict=True))
        fitted = frozenset(name for name, one in named.items() if np.isfinite(one))
        refused = {name: one for name, one in named.items() if one > MAX_FIT_RMS_M}
        self._examined.append(_Examined(t_ns, fitted, refused, frozenset(faults)))
        while t_ns - self._examined[0].t_ns > MISFIT_NS:
            self._examined.popleft()
        if (
            not self.faults
            and not self.misfits
            and not any(one.refused or one.faults for one in self._examined)
        ):
            return []
        return [*self._end(t_ns), *self._begin(t_ns)]

    def _frames(self, t_ns: int, parts: Iterable[str], span_ns: int) -> list[_Examined]:
        """Return the frames of the last `span_ns` in which all `parts` had enough markers."""
        needed = set(parts)
        return [
            one for one in self._examined if t_ns - one.t_ns <= span_ns and needed <= one.fitted
        ]

    def _begin(self, t_ns: int) -> list[Output]:
        """Return notices of the faults and misfits that begin."""
        recent = Counter(
            fault
            for one in self._examined
            if t_ns - one.t_ns <= FAULT_NS
            for fault in one.faults.difference(self.faults)
        )
        notices: list[Output] = []
        for fault, count in sorted(recent.items()):
            frames = self._frames(t_ns, fault.parts, FAULT_NS)
            if len(frames) < _FEWEST or count < _PRESENT * len(frames):
                continue
            # The new fault replaces earlier faults that explained the same markers.
            for other in [f for f in self.faults if not set(f.markers).isdisjoint(fault.markers)]:
                del self.faults[other]
            # A cluster may fit although it is part of the fault, because only its pose relative to
            # adjacent clusters is wrong.
            bad = sum(not one.refused.keys().isdisjoint(fault.parts) for one in frames)
            parts = frozenset(fault.parts)
            fits = bad < _PRESENT * len(frames)
            self.faults[fault] = parts | self._search.neighbors(parts) if fits else parts
            self.misfits -= set(fault.parts)
            notices.append(_fault_notice(t_ns, fault))

        explained = {part for fault in self.faults for part in fault.parts} | self.misfits
        doubtful = {part for one in self._examined for part in one.refused} - explained
        for part in sorted(doubtful):
            frames = self._frames(t_ns, [part], MISFIT_NS)
            refused = [one.refused[part] for one in frames if part in one.refused]
            if len(frames) > 2 * _FEWEST and len(refused) >= _REFUSED * len(frames):
                self.misfits |= {part}
                notices.append(_misfit_notice(t_ns, part, float(np.median(refused))))
        self._hide()
        return notices

    def _end(self, t_ns: int) -> list[Output]:
        """Return notices of the faults and misfits that end."""
        notices: list[Output] = []
        for fault, needed in sorted(self.faults.items()):
            frames = self._frames(t_ns, needed, FAULT_NS)
            bad = sum(
                fault in one.faults or not one.refused.keys().isdisjoint(fault.parts)
                for one in frames
            )
            if len(frames) >= _FEWEST and bad <= _ABSENT * len(frames):
                del self.faults[fault]
                text = f"{join_words(fault.markers)}: at the expected place again, and in use"
                notices.append(_notice(t_ns, fault.markers[0], "ok", text, fault))
        for part in sorted(self.misfits):
            frames = self._frames(t_ns, [part], FAULT_NS)
            bad = sum(part in one.refused for one in frames)
            if len(frames) >= _FEWEST and bad <= _ABSENT * len(frames):
                self.misfits -= {part}
                text = f"{part}: its markers match the static pose again"
                notices.append(Notice(t_ns, NoticeKind.MARKER, part, text, data={"state": "ok"}))
        return notices

    def _hide(self) -> None:
        """Find the columns of the faulty markers in the current layout."""
        names = {name for fault in self.faults for name in fault.markers}
        columns = zip(self._search.labels, self._columns, strict=False)
        found = [column for name, column in columns if name in names and column >= 0]
        self._hidden = np.array(found, dtype=np.intp)


def _centers(chain: Chain, calibration: Calibration) -> dict[tuple[str, str], Vector]:
    """Return the known joint centers in the optical world during the static pose, m.

    The keys are pairs of adjacent body parts.
    """
    parts, found = body_parts(chain), {}
    for name, (proximal, distal) in zip(chain.joints, joint_parts(chain), strict=True):
        joint = calibration.joint.get(name)
        above, below = parts[proximal], parts[distal] if distal < len(parts) else None
        if joint is not None and joint.center is not None and above and below:
            found[above, below] = joint.center
    return found


def _fault_notice(t_ns: int, fault: LabelFault) -> Notice:
    names = fault.markers
    if len(names) == 1:
        text = (
            f"{names[0]}: not at its place on {fault.parts[0]} in the static pose: "
            "check its label and whether it was displaced, or repeat the calibration. It is not "
            "used until then"
        )
        return _notice(t_ns, names[0], MarkerFlag.MISPLACED, text, fault)
    text = f"{fault.text}. Correct the labels; these markers are not used until then"
    return _notice(t_ns, names[0], MarkerFlag.EXCHANGED, text, fault)


def _misfit_notice(t_ns: int, part: str, rms: float) -> Notice:
    text = (
        f"{part}: its markers do not match the static pose: {1000 * rms:.0f} mm RMS, at most "
        f"{1000 * MAX_FIT_RMS_M:g} mm expected, and no single exchange of labels explains it. "
        "Check labels and places, or repeat the calibration. Until then, the cameras give no pose "
        "of this part"
    )
    data = {"state": MarkerFlag.MISFIT.value, "rms_m": round(rms, 4)}
    return Notice(t_ns, NoticeKind.MARKER, part, text, NoticeLevel.WARNING, data)


def _notice(t_ns: int, name: str, state: str, text: str, fault: LabelFault) -> Notice:
    level = NoticeLevel.INFO if state == "ok" else NoticeLevel.WARNING
    data = {"state": str(state), "markers": list(fault.markers), "segments": list(fault.parts)}
    return Notice(t_ns, NoticeKind.MARKER, name, text, level, data)
