"""The lag of every sensor while it runs, and what to say when it changes.

Law: pure and bounded; fed with stamped samples and camera frames, it keeps the last window of
each and works on one window at a time, one small step at every ``step``: acquisition never waits
for a whole fit, and a replay takes the same steps. It watches; calibration decides what is used.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.driver import ImuSettings
from jointfit_daemon.limb_model import live_cluster, rigid_fit
from jointfit_daemon.pipeline.events import Notice
from jointfit_daemon.timing.lag import (
    LagEstimate,
    LagSettings,
    LagTracker,
    estimate_in_steps,
    rates_from_orientations,
)

if TYPE_CHECKING:
    from collections.abc import Generator, Mapping

    from numpy.typing import NDArray

    from jointfit_daemon.config import Rig
    from jointfit_daemon.limb_model import Calibration, Cluster
    from jointfit_daemon.model import Chain, MocapFrame, Quaternion
    from jointfit_daemon.timing.lag import TrackedLag

    Track = tuple[NDArray[np.int64], NDArray[np.float64]]

WINDOW_NS = 10_000_000_000
HOP_NS = 2_500_000_000
MARGIN_NS = 300_000_000
"""More of a sensor than of the cameras: the lag and the filter's ends need it."""
DRIFT_FAULT = 2e-6
"""A lag between two mapped clocks that moves faster is the fault of a clock fit."""
STEP_DOUBT_NS = 1_000_000.0
CONTRADICTION = 4.0
"""Sigmas between a known lag and the motion from which on one of them is wrong."""
RESTART_SD_NS = 1_000_000.0
"""How far a clock that began anew may settle from where it was."""
MOST = 6_000
"""Samples of a sensor or of the cameras kept: a window at 500 Hz."""
_FRAMES_A_STEP = 150
_LEAST_FRAMES = 100


class KnownLag(NamedTuple):
    """A lag that needs no estimate: ``lag_ms`` of rig.toml, from a sync line or a measurement."""

    lag_ns: float
    sigma_ns: float


def known_lags(rig: Rig) -> dict[str, KnownLag]:
    """Return the lags that a rig's tables give."""
    asked = {source.id: source.settings for source in rig.sources if source.kind == "imu"}
    return {
        name: KnownLag(1e6 * settings.lag_ms, 1e6 * settings.lag_sd_ms)
        for name, settings in asked.items()
        if isinstance(settings, ImuSettings) and settings.lag_ms is not None
    }


class _Window(NamedTuple):
    """One window at work."""

    sensor: str
    center_ns: int
    work: Generator[None, None, LagEstimate]


class _Sensor:
    """What is known of one sensor."""

    __slots__ = ("contradicted", "drifted", "epoch", "refused", "samples", "tracked", "tracker")

    def __init__(self) -> None:
        self.samples: deque[tuple[int, Quaternion]] = deque(maxlen=MOST)
        self.tracker = LagTracker(window_s=WINDOW_NS * 1e-9, hop_s=HOP_NS * 1e-9)
        self.tracked: TrackedLag | None = None
        self.refused: str | None = None
        self.epoch: int | None = None
        self.drifted = self.contradicted = False


class LagWatch:
    """Watches the lags of a limb's sensors against its markers.

    Parameters
    ----------
    chain : Chain
        Which sensor sits on which segment.
    calibration : Calibration or None
        Its clusters say which markers make a segment, its lags are what is in force; without it
        nothing is watched.
    before : LagWatch, optional
        Goes on with its lags: a calibration that changed is no change of clocks.
    known : mapping, optional
        Lags that rig.toml gives: they are used, and the motion only checks them.
    """

    def __init__(
        self,
        chain: Chain,
        calibration: Calibration | None,
        before: LagWatch | None = None,
        known: Mapping[str, KnownLag] | None = None,
    ) -> None:
        clusters = {} if calibration is None else calibration.clusters
        self._clusters = {
            name: live_cluster(name, clusters[name]) for name in chain.segments if name in clusters
        }
        self._segment = {
            sensor: segment
            for segment, group in zip(chain.segments, chain.sensors, strict=True)
            for sensor in group
        }
        self._stored = {} if calibration is None else calibration.lag_ns
        self._said = {} if calibration is None else calibration.quality.get("lag") or {}
        self._known = dict(known or {})
        self._sensors = {name: _Sensor() for name in self._segment}
        self._frames: deque[tuple[int, MocapFrame]] = deque(maxlen=MOST)
        self._waiting: deque[tuple[str, int]] = deque()
        self._window: _Window | None = None
        self._next_ns: int | None = None
        self._mocap_epoch: int | None = None
        self._seen: dict[str, tuple[int, Track]] = {}
        for name, old in ({} if before is None else before.memory).items():
            state = self._sensors.get(name)
            if state is not None:
                state.tracker, state.tracked, state.epoch = old.tracker, old.tracked, old.epoch

    # --- in ----------------------------------------------------------------------------------

    def add_sample(self, sensor: str, t_ns: int, q: Quaternion, epoch: int = 0) -> None:
        """Take one orientation; an epoch of its clock that is new ends the track so far."""
        state = self._sensors.get(sensor)
        if state is None or not self._clusters or self._next_ns is None:
            return
        samples = state.samples
        if state.epoch not in (None, epoch):
            samples.clear()
            state.tracker.widen(RESTART_SD_NS)
        state.epoch = epoch
        if samples and t_ns <= samples[-1][0]:
            return
        samples.append((t_ns, q))
        while samples[0][0] < t_ns - WINDOW_NS - 4 * MARGIN_NS:
            samples.popleft()

    def add_mocap(self, t_ns: int, frame: MocapFrame, epoch: int = 0) -> None:
        """Take one live camera frame."""
        if not self._clusters:
            return
        frames = self._frames
        if self._mocap_epoch not in (None, epoch):
            self._begin_again()
        elif frames and frames[-1][1].layout != frame.layout:
            frames.clear()
        self._mocap_epoch = epoch
        if frames and t_ns <= frames[-1][0]:
            return
        frames.append((t_ns, frame))
        while frames[0][0] < t_ns - WINDOW_NS - 2 * MARGIN_NS:
            frames.popleft()
        if self._next_ns is None:
            self._next_ns = t_ns + WINDOW_NS
        elif t_ns >= self._next_ns + MARGIN_NS and not self._waiting and self._window is None:
            self._waiting.extend((sensor, self._next_ns) for sensor in self._sensors)
            self._next_ns = max(self._next_ns + HOP_NS, t_ns - MARGIN_NS)

    def _begin_again(self) -> None:
        """Forget the cameras' frames: their clock began anew."""
        self._frames.clear()
        self._next_ns = None
        for state in self._sensors.values():
            state.tracker.widen(RESTART_SD_NS)

    # --- work --------------------------------------------------------------------------------

    def step(self, now_ns: int) -> list[Notice]:
        """Do a few milliseconds of work, if there is any, and return what is worth telling."""
        window = self._window
        if window is None:
            if self._waiting:
                sensor, end_ns = self._waiting.popleft()
                work = self._estimate(sensor, end_ns)
                self._window = _Window(sensor, end_ns - WINDOW_NS // 2, work)
            return []
        try:
            next(window.work)
        except StopIteration as done:
            self._window = None
            return self._take(now_ns, window, done.value)
        return []

    def _estimate(self, sensor: str, end_ns: int) -> Generator[None, None, LagEstimate]:
        start_ns = end_ns - WINDOW_NS
        segment = self._segment[sensor]
        if segment not in self._clusters:
            return _nothing(f"no markers of {segment} in the calibration: calibrate with cameras")
        if self._seen.get(segment, (0, None))[0] != end_ns:
            rows = [row for row in self._frames if start_ns <= row[0] <= end_ns]
            if len(rows) < _LEAST_FRAMES:
                return _nothing("the cameras gave too few frames: check that they stream")
            track = yield from _orientations(self._clusters[segment], rows)
            self._seen[segment] = end_ns, track
        t_ref, q_ref = self._seen[segment][1]
        low, high = start_ns - MARGIN_NS, end_ns + MARGIN_NS
        samples = [row for row in self._sensors[sensor].samples if low <= row[0] <= high]
        if len(samples) < _LEAST_FRAMES:
            return _nothing("too few samples of the sensor: check that it streams")
        t_imu = np.array([row[0] for row in samples], dtype=np.int64)
        q_imu = np.array([row[1] for row in samples], dtype=np.float64)
        yield
        imu = rates_from_orientations(t_imu, q_imu, start_ns)
        yield
        ref = rates_from_orientations(t_ref, q_ref, start_ns)
        yield
        return (yield from estimate_in_steps(imu, ref, LagSettings()))

    def _take(self, now_ns: int, window: _Window, estimate: LagEstimate) -> list[Notice]:
        name, state = window.sensor, self._sensors[window.sensor]
        state.refused = estimate.refused
        state.tracked = tracked = state.tracker.feed(window.center_ns, estimate)
        if tracked is None or estimate.refused is not None:
            return []
        told = []
        if tracked.step_ns is not None:
            told.append(_stepped(now_ns, name, tracked.step_ns))
        off = abs(tracked.drift) - DRIFT_FAULT
        drifts = off > 2.0 * tracked.drift_sigma
        if drifts and not state.drifted:
            told.append(_drifts(now_ns, name, tracked))
        state.drifted = drifts or (state.drifted and off > 0.0)
        return [*told, *self._contradiction(now_ns, name, state, tracked)]

    def _contradiction(
        self, now_ns: int, name: str, state: _Sensor, tracked: TrackedLag
    ) -> list[Notice]:
        known = self._known.get(name)
        if known is None:
            return []
        apart = tracked.lag_ns - known.lag_ns
        sigma = float(np.hypot(tracked.sigma_ns, known.sigma_ns))
        before, state.contradicted = state.contradicted, abs(apart) > CONTRADICTION * sigma
        if before or not state.contradicted:
            return []
        text = (
            f"the motion says a lag of {_ms(tracked.lag_ns)}, rig.toml {_ms(known.lag_ns)}: "
            f"{abs(apart) / sigma:.0f} sigma apart; check the sync cable and lag_ms"
        )
        return [Notice(now_ns, "clock", name, text, "warning", {"lag_ms": tracked.lag_ns * 1e-6})]

    # --- out ---------------------------------------------------------------------------------

    @property
    def memory(self) -> Mapping[str, _Sensor]:
        """What a watch that takes over goes on with."""
        return self._sensors

    def known_ns(self) -> dict[str, int]:
        """Return the lags that rig.toml gives."""
        return {name: round(lag.lag_ns) for name, lag in self._known.items()}

    def tracked(self) -> dict[str, tuple[float, float]]:
        """Return the lags seen while running, and their standard deviations, ns."""
        return {
            name: (state.tracked.lag_ns, state.tracked.sigma_ns)
            for name, state in self._sensors.items()
            if state.tracked is not None
        }

    def health(self) -> dict[str, dict[str, object]]:
        """Return for every sensor what is known of its lag, JSON-able."""
        return {sensor: self._health(sensor) for sensor in self._sensors}

    def _health(self, sensor: str) -> dict[str, object]:
        state = self._sensors[sensor]
        known, tracked, stored = self._known.get(sensor), state.tracked, self._stored.get(sensor)
        used, source = (None, "none") if stored is None else (float(stored), "calibration")
        if known is not None:
            used, source = known.lag_ns, "configured"
        said = self._said.get(sensor, {})
        return {
            "lag_ms": _rounded(used),
            "lag_sigma_ms": _rounded(said.get("sigma_ns") if known is None else known.sigma_ns),
            "lag_source": source,
            "lag_found_by": None if known is not None else said.get("source"),
            "tracked_ms": None if tracked is None else _rounded(tracked.lag_ns),
            "tracked_sigma_ms": None if tracked is None else _rounded(tracked.sigma_ns),
            "tracked_drift_ppm": None if tracked is None else round(1e6 * tracked.drift, 3),
            "tracked_refused": state.refused,
        }


def _rounded(value_ns: float | None) -> float | None:
    return None if value_ns is None else round(value_ns * 1e-6, 3)


def _orientations(
    cluster: Cluster, rows: list[tuple[int, MocapFrame]]
) -> Generator[None, None, Track]:
    """Return where a segment's markers were turned to, a few frames a step."""
    layout = rows[0][1].layout
    parts = []
    if cluster.body is not None:
        column = layout.bodies.index(cluster.body) if cluster.body in layout.bodies else None
        for _, frame in rows:
            q = np.full(4, np.nan) if column is None else frame.body_orientations[column]
            parts.append(q[None])
    else:
        places = [layout.markers.index(m) if m in layout.markers else -1 for m in cluster.markers]
        unseen = np.full((1, 3), np.nan)  # row -1: a marker that the stream does not name
        for at in range(0, len(rows), _FRAMES_A_STEP):
            positions = np.stack(
                [
                    np.concatenate((frame.markers, unseen))[places]
                    for _, frame in rows[at : at + _FRAMES_A_STEP]
                ]
            )
            parts.append(rigid_fit(cluster.template, positions)[0])
            yield
    return np.array([t for t, _ in rows], dtype=np.int64), np.concatenate(parts)


def _nothing(refused: str) -> LagEstimate:
    return LagEstimate(np.nan, np.inf, np.nan, refused)


def _stepped(now_ns: int, name: str, step_ns: float) -> Notice:
    text = f"the lag stepped by {_ms(step_ns)}: a clock or a filter changed"
    doubt = abs(step_ns) > STEP_DOUBT_NS
    if doubt:
        text += "; the calibration is in doubt: run the functional phase again"
    data = {"step_ms": round(step_ns * 1e-6, 3)}
    if not doubt:
        return Notice(now_ns, "clock", name, text, "info", data)
    return Notice(now_ns, "calibration", name, text, "warning", data)


def _drifts(now_ns: int, name: str, tracked: TrackedLag) -> Notice:
    text = (
        f"the lag drifts by {1e6 * tracked.drift:.1f} ppm although both clocks are mapped: one of "
        "the two fits is wrong; restart the sensor, then the mocap server"
    )
    return Notice(
        now_ns, "clock", name, text, "warning", {"drift_ppm": round(1e6 * tracked.drift, 2)}
    )


def _ms(value_ns: float) -> str:
    return f"{value_ns * 1e-6:.2f} ms"
