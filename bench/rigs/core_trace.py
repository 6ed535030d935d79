"""Trace of a run: every stamp, every frame, every clock twice per second, and every lag.

Invariant: the events pass through the core of the daemon, which is only observed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from typing_extensions import override

from jointfit_daemon.model import MocapFrame
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import ChunkArrived
from jointfit_daemon.pipeline.sources import StampedMeasurement
from jointfit_daemon.timing.lag import estimate_lag
from jointfit_daemon.units import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from jointfit_daemon.model import Corrupt, DeviceEvent, LimbState
    from jointfit_daemon.pipeline.events import Event, Output
    from jointfit_daemon.pipeline.sources import SourceState
    from jointfit_daemon.timing.alignment import AlignedFrame
    from jointfit_daemon.timing.clock import DeviceClock
    from jointfit_daemon.timing.lag import LagEstimate

    Floats = NDArray[np.float64]

LOOK_NS = NS_PER_S // 2
"""Time between two records of the clocks, ns."""
WINDOW_S, HOP_S = 10.0, 2.5


class Stamping(NamedTuple):
    """Stamp of one sample."""

    arrival_ns: int
    t_ns: int
    sigma_ns: float
    synced: bool
    ticks: int | None


class Look(NamedTuple):
    """State of one clock at one time; None for unknown values."""

    at_ns: int
    offset_ns: float | None
    skew_ppm: float | None
    sigma_ns: float | None
    jitter_ns: float | None


class Frame(NamedTuple):
    """One frame of the limb."""

    t_ns: int
    completed_ns: int
    synced: bool
    missing: int
    extrapolated: int


class LagWindow(NamedTuple):
    """One lag window of a sensor, and the rigid body that carries the sensor."""

    at_ns: int
    body: str
    estimate: LagEstimate


@dataclass
class Trace:
    """All records of a run."""

    begin_ns: int = 0
    latency_ns: dict[str, int] = field(default_factory=dict)
    """Minimum delay of each transport that the clock assumes and subtracts, ns."""
    stamps: dict[str, list[Stamping]] = field(default_factory=dict)
    looks: dict[str, list[Look]] = field(default_factory=dict)
    frames: list[Frame] = field(default_factory=list)
    turns: dict[str, list[tuple[int, Floats]]] = field(default_factory=dict)
    """Orientations by sensor, or by optical body with the key ``mocap/NAME``; stamps increase."""
    lags: dict[str, list[LagWindow]] = field(default_factory=dict)


class TracingCore(Core):
    """Core that records the state of its clocks."""

    def __init__(self) -> None:
        super().__init__()
        self.trace = Trace()
        self._looked_ns = 0

    @override
    def feed(self, event: Event) -> list[Output]:
        outputs = super().feed(event)
        if isinstance(event, ChunkArrived) and event.chunk.t_ns - self._looked_ns >= LOOK_NS:
            self._looked_ns = event.chunk.t_ns
            for name, state in self._sources.items():
                self.trace.looks.setdefault(name, []).append(_look(self._looked_ns, state.clock))
        return outputs

    @override
    def _process(
        self,
        source: str,
        state: SourceState,
        items: list[StampedMeasurement | Corrupt | DeviceEvent],
    ) -> list[Output]:
        for item in items:
            if isinstance(item, StampedMeasurement) and not item.stamp.duplicate:
                self._write(source, state, item)
        return super()._process(source, state, items)

    def _write(self, source: str, state: SourceState, item: StampedMeasurement) -> None:
        trace, measured, stamp = self.trace, item.measurement, item.stamp
        trace.latency_ns.setdefault(source, state.clock.latency_ns)
        row = Stamping(
            measured.arrival_ns, stamp.t_ns, stamp.sigma_ns, stamp.synced, measured.ticks
        )
        trace.stamps.setdefault(source, []).append(row)
        if isinstance(measured, MocapFrame):
            bodies = measured.layout.bodies
            for name, q in zip(bodies, measured.body_orientations, strict=True):
                self._turn(f"{source}/{name}", stamp.t_ns, q)
        elif stamp.synced:
            self._turn(source, stamp.t_ns, np.array(measured.q_world_sensor))

    def _turn(self, name: str, t_ns: int, q: Floats) -> None:
        turns = self.trace.turns.setdefault(name, [])
        if not turns or t_ns > turns[-1][0]:
            turns.append((t_ns, q))

    @override
    def _fuse(self, frame: AlignedFrame) -> LimbState:
        self.trace.frames.append(
            Frame(
                frame.t_ns,
                frame.completed_ns,
                frame.synced,
                len(frame.missing),
                len(frame.extrapolated),
            )
        )
        return super()._fuse(frame)


def _look(at_ns: int, clock: DeviceClock) -> Look:
    return Look(at_ns, clock.offset_ns, clock.skew_ppm, clock.sigma_ns, clock.jitter_ns)


def traced(events: Iterable[Event]) -> Trace:
    """Process `events` in a new core, and return the trace.

    Raises
    ------
    ValueError
        The events contain no sample.
    """
    core = TracingCore()
    for event in events:
        if isinstance(event, ChunkArrived) and not core.trace.begin_ns:
            core.trace.begin_ns = event.chunk.t_ns
        core.feed(event)
    trace = core.trace
    if not trace.stamps:
        raise ValueError("no sample in this run: nothing to draw")
    trace.lags = _lags(trace)
    return trace


# --- lags -------------------------------------------------------------------------------------


def _lags(trace: Trace) -> dict[str, list[LagWindow]]:
    """Return the lag windows of every sensor, for the body with the most accepted windows."""
    tracks = {name: _track(turns) for name, turns in trace.turns.items()}
    bodies = {name: track for name, track in tracks.items() if "/" in name}
    found: dict[str, list[LagWindow]] = {}
    for name, track in tracks.items():
        if name in bodies:
            continue
        windows = [_windows(track, body, body_name) for body_name, body in bodies.items()]
        if windows:
            found[name] = max(windows, key=_accepted)
    return found


def _accepted(windows: list[LagWindow]) -> int:
    return sum(window.estimate.refused is None for window in windows)


def _track(turns: list[tuple[int, Floats]]) -> tuple[NDArray[np.int64], Floats]:
    return np.array([t for t, _ in turns]), np.array([q for _, q in turns])


def _windows(
    track: tuple[NDArray[np.int64], Floats],
    body: tuple[NDArray[np.int64], Floats],
    name: str,
) -> list[LagWindow]:
    windows: list[LagWindow] = []
    begin_ns, end_ns = max(track[0][0], body[0][0]), min(track[0][-1], body[0][-1])
    window_ns = round(WINDOW_S * NS_PER_S)
    for low in range(int(begin_ns), int(end_ns) - window_ns + 1, round(HOP_S * NS_PER_S)):
        imu, ref = _cut(track, low, low + window_ns), _cut(body, low, low + window_ns)
        if np.isfinite(ref[1]).all(axis=-1).any():
            windows.append(LagWindow(low + window_ns // 2, name, estimate_lag(*imu, *ref)))
    return windows


def _cut(
    track: tuple[NDArray[np.int64], Floats], low: int, high: int
) -> tuple[NDArray[np.int64], Floats]:
    now = slice(*np.searchsorted(track[0], [low, high]))
    return track[0][now], track[1][now]


def true_errors(
    trace: Trace, taken_ns: Mapping[tuple[str, int], int], unseen_ns: Mapping[str, int]
) -> dict[str, tuple[Floats, Floats, NDArray[np.bool_]]]:
    """Return by stream: time since the start (s), error of the stamp (ms), and synced flag.

    The error does not contain the minimum delay of the transport, which no clock can estimate.
    """
    errors = {}
    for name, rows in trace.stamps.items():
        known = [row for row in rows if (name, row.ticks) in taken_ns and row.ticks is not None]
        unseen = unseen_ns.get(name, 0)
        if unseen:  # the clock has already subtracted the assumed delay
            unseen -= trace.latency_ns[name]
        t_s = np.array([(row.arrival_ns - trace.begin_ns) / NS_PER_S for row in known])
        error = [(row.t_ns - unseen - taken_ns[name, row.ticks or 0]) / 1e6 for row in known]
        errors[name] = (t_s, np.array(error), np.array([row.synced for row in known]))
    return errors
