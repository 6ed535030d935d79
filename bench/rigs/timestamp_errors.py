"""Errors of the daemon's stamps relative to the true sampling times.

Invariant: the replay of the recording yields every stamp of the live run, and the simulator's
sample log contains the true time of each sample. The error is the stamp minus the true time, except
for a constant that arrival times cannot reveal. If a stamp is based on arrivals, the true minimum
delay of the transport replaces the assumed delay. With an active lag correction or sync edges,
nothing is replaced.

On a loaded machine, samples arrive later. Without a fast sample, no clock can estimate the delay.
The part of an error with this cause is reported separately (`excused_ns`). It is the additional
delay of the fastest sample since the clock started. It decreases at most at the slew rate of the
stamps.
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
from jointfit_daemon.units import NS_PER_MS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from jointfit_daemon.model import Corrupt, DeviceEvent
    from jointfit_daemon.pipeline.events import Event, Output
    from jointfit_daemon.pipeline.sources import SourceState
    from jointfit_daemon.timing.alignment import AlignedFrame
    from jointfit_daemon.timing.clock import Stamp

OPTICAL = "mocap"
MOST_NS = 2_000_000_000
"""Upper limit of the transport delay of a sample, ns."""


class ObservedSample(NamedTuple):
    """One sample."""

    source: str
    arrival_ns: int
    t_ns: int
    """Stamp that the frames use, ns: the stamp of the clock minus the active lag."""
    synced: bool
    method: str
    """Clock method, such as `passive`, `echo` or `direct`."""
    error_ns: int | None
    """Error of the stamp, ns; None if the simulator has no such sample."""
    excused_ns: int
    """Part of the error that late arrivals explain, ns (see the docstring of the module)."""


class JudgedFrame(NamedTuple):
    """One published frame."""

    t_ns: int
    completed_ns: int
    synced: bool
    worst_ns: float
    """Largest error among the samples of the frame, over all sensors, ns; 0 if no error is known.
    """
    sensors: int
    unexcused_ns: float = 0.0
    """Largest error without the excused part, ns."""


class Truth:
    """True sampling times, by device and sample number.

    Parameters
    ----------
    path
        ``samples.jsonl`` of the simulator.
    """

    def __init__(self, path: Path) -> None:
        self._taken: defaultdict[tuple[str, int], list[int]] = defaultdict(list)
        with path.open("rb") as file:
            for line in file:
                sample = orjson.loads(line)
                self._taken[sample["id"], sample["number"]].append(sample["host_ns"])

    def taken_ns(self, source: str, number: int, arrival_ns: int) -> int | None:
        """Return the true time of the sample with this number that arrived at `arrival_ns`."""
        instants = self._taken.get((source, number), [])
        at = bisect_right(instants, arrival_ns)
        if at == 0 or arrival_ns - instants[at - 1] > MOST_NS:
            return None
        return instants[at - 1]


@dataclass(slots=True)
class _Recent:
    """Stamps and errors of the samples of one source, in order of arrival."""

    t_ns: list[int] = field(default_factory=list)
    error_ns: list[int | None] = field(default_factory=list)
    excused_ns: list[int] = field(default_factory=list)
    epoch: int = -1
    least_ns: int = 0
    """Smallest delay since the last start of the clock, in excess of the minimum delay, ns."""

    def excuse(self, late_ns: int | None, stamp: Stamp) -> int:
        """Add the delay of a sample; return the part of its error that the delays explain."""
        if stamp.epoch != self.epoch:
            self.epoch, self.least_ns = stamp.epoch, MOST_NS
        if late_ns is not None:
            self.least_ns = min(self.least_ns, late_ns)
        excused_ns = max(0, self.least_ns)
        if not (stamp.synced and self.excused_ns):
            return excused_ns
        return max(excused_ns, self.excused_ns[-1] - round(SLEW * (stamp.t_ns - self.t_ns[-1])))


class ObservedCore(Core):
    """Core that records its stamps and frames.

    Parameters
    ----------
    truth
        True sampling times.
    delay_ns
        Minimum delay of the transport, ns, by source; the default is 0.
    """

    def __init__(self, truth: Truth, delay_ns: Mapping[str, int]) -> None:
        super().__init__()
        self._truth, self._delay_ns = truth, delay_ns
        self._recent: defaultdict[str, _Recent] = defaultdict(_Recent)
        self.samples: list[ObservedSample] = []
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
        arrival_ns = self._now_ns  # not `measured.arrival_ns`, which may be back-dated
        taken_ns = None if number is None else self._truth.taken_ns(source, number, arrival_ns)
        known = lag_ns or state.clock.state not in {"passive", "settling", "arrival"}
        unseen_ns = 0 if known else self._delay_ns.get(source, 0) - state.clock.latency_ns
        error_ns = None if taken_ns is None else t_ns - unseen_ns - taken_ns
        recent, delay_ns = self._recent[source], self._delay_ns.get(source, 0)
        late_ns = None if taken_ns is None else measured.arrival_ns - taken_ns - delay_ns
        excused_ns = 0 if known else recent.excuse(late_ns, stamp)
        self.samples.append(
            ObservedSample(
                source, arrival_ns, t_ns, stamp.synced, state.clock.state, error_ns, excused_ns
            )
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
        """Return the larger error of the two samples around `t_ns`, ns.

        The first value is the complete error, and the second value lacks the excused part.
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
    """Return the absolute error without its excused part, ns.

    Only stamps after the true time have an excused part.
    """
    return max(-error_ns, error_ns - excused_ns, 0)


def judge(
    events: Iterable[Event], samples: Path, delay_ms: Mapping[str, float]
) -> tuple[ObservedCore, list[LimbState]]:
    """Return the observed core after all events, and its limb states."""
    delays = {name: round(delay * NS_PER_MS) for name, delay in delay_ms.items()}
    core = ObservedCore(Truth(samples), delays)
    states: list[LimbState] = []
    for event in events:
        states += [output for output in core.feed(event) if isinstance(output, LimbState)]
    return core, states
