"""The grid of frames of a rig, and the verdicts on its sensors' samples.

Invariant: frames are owed from the first configuration on, with or without samples, and their
instants grow across reloads. A reload begins a new grid only where it lays frames out anew; samples
that waited get their verdict then, and counts go on for every sensor that is still there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.timing.alignment import FrameAligner, StreamSpec

if TYPE_CHECKING:
    from jointfit_daemon.config import Rig

_NS = 1_000_000_000


class FrameGrid:
    """Aligns the sensors of one rig, from reload to reload.

    Parameters
    ----------
    rig : Rig
        The first one.
    begin_ns : int
        Host time from which on frames are owed, ns.
    """

    def __init__(self, rig: Rig, begin_ns: int) -> None:
        self._layout = _layout(rig)
        self._names = _sensors(rig)
        self._before: dict[str, dict[str, int]] = {}
        """Counts of aligners that a reload replaced."""
        self.aligner = _aligner(rig, begin_ns)

    def follow(self, rig: Rig) -> None:
        """Go on with a rig that was reloaded."""
        if _layout(rig) == self._layout:
            return
        self.aligner.close()
        known = self.verdicts()
        self.aligner = _aligner(rig, self.aligner.next_ns)
        self._layout, self._names = _layout(rig), _sensors(rig)
        # one that is gone takes its counts along: it may come back, and begins at nothing then
        self._before = {name: known[name] for name in self._names if name in known}

    def verdicts(self) -> dict[str, dict[str, int]]:
        """Return the verdicts on every sensor's samples since the daemon started."""
        return {name: self._counts(name) for name in self._names}

    def _counts(self, name: str) -> dict[str, int]:
        before = self._before.get(name, {})
        return {key: n + before.get(key, 0) for key, n in self.aligner.counts(name).items()}


def _layout(rig: Rig) -> tuple[object, ...]:
    imus = tuple((s.id, s.rate_hz) for s in rig.sources if s.kind == "imu")
    return rig.output_rate_hz, rig.align_mode, imus


def _sensors(rig: Rig) -> tuple[str, ...]:
    return tuple(source.id for source in rig.sources if source.kind == "imu")


def _aligner(rig: Rig, begin_ns: int | None) -> FrameAligner:
    streams = {
        source.id: StreamSpec(round(_NS / source.rate_hz))
        for source in rig.sources
        if source.kind == "imu"
    }
    period_ns = round(_NS / rig.output_rate_hz)
    return FrameAligner(streams, period_ns, mode=rig.align_mode, begin_ns=begin_ns)
