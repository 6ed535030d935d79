"""Stamps of a real daemon against the instants at which its samples were truly taken.

Law: the daemon's event log, fed to the same core again, gives every stamp that the live run gave;
the simulator's sample log says when each sample was taken. Their difference is the error, but for
the constant that no arrival can tell: where a stamp rests on arrivals, the transport's true least
delay takes the place of the one the daemon assumed. With a lag in force, or edges of a sync line,
nothing is taken off.

On a machine that is short of time samples come later still, and before a quick one has come no
clock can know. How much of an error that explains is told apart (`excused_ns`): what the quickest
sample since the clock began took beyond the least delay, slewed down as stamps are.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import defaultdict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import orjson
from typing_extensions import override

from jointfit_daemon.model import ImuSample, LimbState
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.sources import StampedMeasurement
from jointfit_daemon.timing.clock import SLEW

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from jointfit_daemon.model import Corrupt, DeviceEvent
    from jointfit_daemon.pipeline.events import Event, Output
    from jointfit_daemon.pipeline.sources import SourceState
    from jointfit_daemon.timing.alignment import AlignedFrame
    from jointfit_daemon.timing.clock import Stamp

_NS_PER_MS = 1e6
OPTICAL = "mocap"
MOST_NS = 2_000_000_000
"""A sample is on its way for less than this."""


class Judged(NamedTuple):
    """One sample."""

    source: str
    arrival_ns: int
    t_ns: int
    """As it went into frames: its stamp less the lag in force."""
    synced: bool
    method: str
    """How its clock told time: `passive`, `echo`, `direct` …"""
    error_ns: int | None
    """None: the simulator knows of no such sample."""
    excused_ns: int
    """How late every sample of this clock has been so far, beyond the least delay."""


class JudgedFrame(NamedTuple):
    """One frame that was published."""

    t_ns: int
    completed_ns: int
    synced: bool
    worst_ns: float
    """Largest error among the samples next to it, of every sensor in it; 0 if none is known."""
    sensors: int
    unexcused_ns: float = 0.0
    """The same, but for what is excused."""


class Truth:
    """True instants by device and number.

    Parameters
    ----------
    path
        The simulator's ``samples.jsonl``.
    """

    def __init__(self, path: Path) -> None:
        self._taken: defaultdict[tuple[str, int], list[int]] = defaultdict(list)
        with path.open("rb") as file:
            for line in file:
                sample = orjson.loads(line)
                self._taken[sample["id"], sample["number"]].append(sample["host_ns"])

    def taken_ns(self, source: str, number: int, arrival_ns: int) -> int | None:
        """Return when the sample of this number that came at `arrival_ns` was taken."""
        instants = self._taken.get((source, number), [])
        at = bisect_right(instants, arrival_ns)
        if at == 0 or arrival_ns - instants[at - 1] > MOST_NS:
            return None
        return instants[at - 1]


@dataclass(slots=True)
class _Recent:
    """Stamps and errors of one source's samples, in order of arrival."""

    t_ns: list[int] = field(default_factory=list)
    error_ns: list[int | None] = field(default_factory=list)
    excused_ns: list[int] = field(default_factory=list)
    epoch: int = -1
    least_ns: int = 0
    """How late the quickest sample of this epoch was."""

    def excuse(self, late_ns: int | None, stamp: Stamp) -> int:
        """Take how late a sample was; return how late nobody can blame the clock for being."""
        if stamp.epoch != self.epoch:
            self.epoch, self.least_ns = stamp.epoch, MOST_NS
        if late_ns is not None:
            self.least_ns = min(self.least_ns, late_ns)
        excused_ns = max(0, self.least_ns)
        if not (stamp.synced and self.excused_ns):
            return excused_ns
        return max(excused_ns, self.excused_ns[-1] - round(SLEW * (stamp.t_ns - self.t_ns[-1])))


class WatchedCore(Core):
    """The core, with somebody who notes every stamp and every frame.

    Parameters
    ----------
    truth
        When samples were taken.
    delay_ns
        Least delay of each source's transport; 0 where it is not given.
    """

    def __init__(self, truth: Truth, delay_ns: Mapping[str, int]) -> None:
        super().__init__()
        self._truth, self._delay_ns = truth, delay_ns
        self._recent: defaultdict[str, _Recent] = defaultdict(_Recent)
        self.samples: list[Judged] = []
        self.frames: list[JudgedFrame] = []

    @override
    def _process(
        self,
        source: str,
        state: SourceState,
        items: list[StampedMeasurement | Corrupt | DeviceEvent],
    ) -> list[Output]:
        for item in items:
            if isinstance(item, StampedMeasurement):
                self._judge(source, item, state)
        return super()._process(source, state, items)

    def _judge(self, source: str, item: StampedMeasurement, state: SourceState) -> None:
        measured, stamp = item.measurement, item.stamp
        number = measured.counter if isinstance(measured, ImuSample) else measured.number
        lag_ns = self._lag_ns.get(source, 0)
        t_ns = stamp.t_ns - lag_ns
        arrival_ns = self._now_ns  # a sample's own is back-dated, and may be before its time
        taken_ns = None if number is None else self._truth.taken_ns(source, number, arrival_ns)
        known = lag_ns or state.clock.state not in {"passive", "settling", "arrival"}
        unseen_ns = 0 if known else self._delay_ns.get(source, 0) - state.clock.latency_ns
        error_ns = None if taken_ns is None else t_ns - unseen_ns - taken_ns
        recent, delay_ns = self._recent[source], self._delay_ns.get(source, 0)
        late_ns = None if taken_ns is None else measured.arrival_ns - taken_ns - delay_ns
        excused_ns = 0 if known else recent.excuse(late_ns, stamp)
        self.samples.append(
            Judged(source, arrival_ns, t_ns, stamp.synced, state.clock.state, error_ns, excused_ns)
        )
        recent.t_ns.append(t_ns)
        recent.error_ns.append(error_ns)
        recent.excused_ns.append(excused_ns)

    @override
    def _fuse(self, frame: AlignedFrame) -> LimbState:
        found = [self._error_at(name, frame.t_ns) for name in frame.orientations]
        worst = max((error for error, _ in found), default=0.0)
        blamed = max((error for _, error in found), default=0.0)
        sensors = len(frame.orientations)
        self.frames.append(
            JudgedFrame(frame.t_ns, frame.completed_ns, frame.synced, worst, sensors, blamed)
        )
        return super()._fuse(frame)

    def _error_at(self, source: str, t_ns: int) -> tuple[float, float]:
        """Return the larger error of the samples that an orientation at `t_ns` is made of.

        And the larger of what is not excused of them.
        """
        recent = self._recent[source]
        begin = max(0, len(recent.t_ns) - 512)
        after = bisect_left(recent.t_ns, t_ns, lo=begin)
        around = slice(max(0, after - 1), after + 1)
        pairs = zip(recent.error_ns[around], recent.excused_ns[around], strict=True)
        known = [(error, excused) for error, excused in pairs if error is not None]
        return (
            max((float(abs(error)) for error, _ in known), default=0.0),
            max((float(unexcused(error, excused)) for error, excused in known), default=0.0),
        )


def unexcused(error_ns: int, excused_ns: int) -> int:
    """Return the size of an error but for what is excused of it: being late, never being early."""
    return max(-error_ns, error_ns - excused_ns, 0)


def judge(
    events: Iterable[Event], samples: Path, delay_ms: Mapping[str, float]
) -> tuple[WatchedCore, list[LimbState]]:
    """Return the watched core after all events, and the limb states it gave."""
    delays = {name: round(delay * _NS_PER_MS) for name, delay in delay_ms.items()}
    core = WatchedCore(Truth(samples), delays)
    states: list[LimbState] = []
    for event in events:
        states += [output for output in core.feed(event) if isinstance(output, LimbState)]
    return core, states
