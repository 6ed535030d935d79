"""Frame grid of a rig, and the counts of its samples.

The grid consists of the regular instants at which limb states are computed. It continues across
reloads.

Invariant: frames are due from the first configuration on, with or without samples, and their
instants increase across reloads. A reload starts a new grid only if it changes rates, sensors or
the alignment mode. In this case the pending samples are counted as dropped, and the counts of the
remaining sensors continue.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.timing.alignment import FrameAligner
from jointfit_daemon.units import NS_PER_S

if TYPE_CHECKING:
    from jointfit_daemon.config import Rig


class FrameGrid:
    """Owns the frame aligner of one rig, and replaces the aligner if a reload needs a new grid.

    Parameters
    ----------
    rig : Rig
        The first configuration.
    begin_ns : int
        Host time from which frames are due, ns.
    """

    def __init__(self, rig: Rig, begin_ns: int) -> None:
        self._layout = _layout(rig)
        self._names = [source.id for source in rig.sources if source.kind == "imu"]
        self._counts_before: dict[str, dict[str, int]] = {}
        """Sample counts of aligners that were replaced at a reload."""
        self.aligner = _aligner(rig, begin_ns)

    def reload(self, rig: Rig) -> None:
        """Apply a reloaded configuration."""
        if _layout(rig) == self._layout:
            return
        self.aligner.close()
        counts = self.counts()
        self.aligner = _aligner(rig, self.aligner.next_ns)
        self._layout = _layout(rig)
        self._names = [source.id for source in rig.sources if source.kind == "imu"]
        # The counts of a removed sensor are deleted. If it is added again, its counts start from 0.
        self._counts_before = {name: counts[name] for name in self._names if name in counts}

    def counts(self) -> dict[str, dict[str, int]]:
        """Return the counts of every sensor's samples since the start of the daemon, by outcome."""
        found = {}
        for name in self._names:
            before = self._counts_before.get(name, {})
            now = self.aligner.counts(name)
            found[name] = {outcome: n + before.get(outcome, 0) for outcome, n in now.items()}
        return found


def _layout(rig: Rig) -> tuple[object, ...]:
    imus = tuple((s.id, s.rate_hz) for s in rig.sources if s.kind == "imu")
    return rig.output_rate_hz, rig.align_mode, imus


def _aligner(rig: Rig, begin_ns: int | None) -> FrameAligner:
    streams = {
        source.id: round(NS_PER_S / source.rate_hz)
        for source in rig.sources
        if source.kind == "imu"
    }
    period_ns = round(NS_PER_S / rig.output_rate_hz)
    return FrameAligner(streams, period_ns, mode=rig.align_mode, begin_ns=begin_ns)
