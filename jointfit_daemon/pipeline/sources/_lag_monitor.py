"""Lag of every sensor behind the mocap system during operation, and notices of changes.

The monitor receives stamped samples and mocap frames, and retains the last window of both. It
estimates the lag in one window at a time. The computation is split into small steps, so acquisition
never waits for a complete fit, and a replay takes the same steps. The monitor does not change the
lags in use, which come from the calibration or from ``rig.toml``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator  # noqa: TC003 - mypyc evaluates the types of fields
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray  # noqa: TC002 - mypyc evaluates the types of fields

from jointfit_daemon.driver import ImuSettings
from jointfit_daemon.limb_model import restore_cluster, rigid_fit
from jointfit_daemon.pipeline.events import Notice, NoticeKind, NoticeLevel
from jointfit_daemon.pipeline.health import LagHealth, LagSource
from jointfit_daemon.timing.lag import (
    LagEstimate,
    LagSettings,
    LagTracker,
    estimate_in_steps,
    rates_from_orientations,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.config import Rig
    from jointfit_daemon.limb_model import Calibration, MarkerCluster
    from jointfit_daemon.model import Chain, MocapFrame, Quaternion
    from jointfit_daemon.timing.lag import Rates, TrackedLag

WINDOW_NS = 10_000_000_000
"""Length of the time window of one estimate, ns."""
HOP_NS = 2_500_000_000
"""Time between the starts of successive windows, ns."""
MARGIN_NS = 300_000_000
"""Length of the margins before and after the window, ns. Samples in the margins are used as well,
because of the lag and of the filter at the ends of the window."""
DRIFT_FAULT = 2e-6
"""Drift of the lag between two synchronized clocks, ns/ns. A larger drift means that a clock fit is
wrong."""
STEP_FAULT_NS = 1_000_000.0
"""Change of the lag above which the calibration is no longer valid, ns."""
CONTRADICTION_SIGMA = 4.0
"""Difference between configured and estimated lag, in standard deviations. A larger difference
means that one of the two lags is wrong."""
RESTART_SD_NS = 1_000_000.0
"""Standard deviation by which the lag may change when a clock restarts, ns."""
MAX_SAMPLES = 6_000
"""Largest number of retained samples per sensor, and of mocap frames. It is sufficient for a window
with its margins at 500 Hz."""
_FRAMES_PER_STEP = 150
_MIN_FRAMES = 100


_LOW_R2 = "no lag from this movement: normal on soft tissue, the lag in use is not changed"
"""Text for a low coefficient of determination R² during tracking. The cause is motion of the sensor
on the skin, which is not a fault."""


class KnownLag(NamedTuple):
    """Lag ``lag_ms`` of rig.toml, which is known from a sync line or a measurement."""

    lag_ns: float
    sigma_ns: float


def known_lags(rig: Rig) -> dict[str, KnownLag]:
    """Return the lags that the sensor tables of a rig define."""
    settings_of = {source.id: source.settings for source in rig.sources if source.kind == "imu"}
    return {
        name: KnownLag(1e6 * settings.lag_ms, 1e6 * settings.lag_sd_ms)
        for name, settings in settings_of.items()
        if isinstance(settings, ImuSettings) and settings.lag_ms is not None
    }


class _Window(NamedTuple):
    """A time window in which the lag is being estimated."""

    sensor: str
    center_ns: int
    work: Generator[None, None, LagEstimate]


class _SegmentTrack(NamedTuple):
    """Orientations of a segment in one window, from its markers, for all sensors on it."""

    end_ns: int
    """End of the window, ns."""
    t_ns: NDArray[np.int64]
    q: NDArray[np.float64]
    rates: Rates | None = None
    """Angular rates, which are computed when the first sensor needs them."""


class _SensorLag:
    """Samples and estimates of one sensor."""

    __slots__ = ("contradicted", "drifted", "epoch", "refused", "samples", "tracked", "tracker")

    def __init__(self) -> None:
        self.samples: deque[tuple[int, Quaternion]] = deque(maxlen=MAX_SAMPLES)
        self.tracker = LagTracker(window_s=WINDOW_NS * 1e-9, hop_s=HOP_NS * 1e-9)
        self.tracked: TrackedLag | None = None
        self.refused: str | None = None
        self.epoch: int | None = None
        self.drifted = self.contradicted = False


class LagMonitor:
    """Estimates the lags of the sensors of a limb against its markers.

    Parameters
    ----------
    chain : Chain
        Limb, with the sensors of each segment.
    calibration : Calibration or None
        Calibration with the marker clusters of the segments and the lags in use. If it is None,
        nothing is estimated.
    before : LagMonitor, optional
        Monitor whose estimates are continued, because a new calibration does not change the clocks.
    known : mapping, optional
        Lags from rig.toml. They are used instead of the estimated lags. The estimated lags then
        only serve to check the lags from rig.toml.
    """

    def __init__(
        self,
        chain: Chain,
        calibration: Calibration | None,
        before: LagMonitor | None = None,
        known: Mapping[str, KnownLag] | None = None,
    ) -> None:
        clusters = {} if calibration is None else calibration.clusters
        self._clusters = {
            name: restore_cluster(name, clusters[name])
            for name in chain.segments
            if name in clusters
        }
        self._segment = {
            sensor: segment
            for segment, group in zip(chain.segments, chain.sensors, strict=True)
            for sensor in group
        }
        self._calibrated = {} if calibration is None else calibration.lag_ns
        self._quality = {} if calibration is None else calibration.quality.get("lag") or {}
        self._known = dict(known or {})
        self.sensors = {name: _SensorLag() for name in self._segment}
        """Samples and estimates by sensor."""
        self._frames: deque[tuple[int, MocapFrame]] = deque(maxlen=MAX_SAMPLES)
        self._waiting: deque[tuple[str, int]] = deque()
        self._window: _Window | None = None
        self._next_ns: int | None = None
        self._mocap_epoch: int | None = None
        self._tracks: dict[str, _SegmentTrack] = {}
        """Track of the last window, by segment. The next window continues it."""
        for name, old in ({} if before is None else before.sensors).items():
            lag = self.sensors.get(name)
            if lag is not None:
                lag.tracker, lag.tracked, lag.epoch = old.tracker, old.tracked, old.epoch

    # --- input -------------------------------------------------------------------------------

    def add_sample(self, sensor: str, t_ns: int, q: Quaternion, epoch: int = 0) -> None:
        """Add one orientation. A new epoch of the sensor's clock discards all earlier samples."""
        lag = self.sensors.get(sensor)
        if lag is None or not self._clusters or self._next_ns is None:
            return
        samples = lag.samples

        if lag.epoch not in (None, epoch):
            samples.clear()
            lag.tracker.widen(RESTART_SD_NS)
        lag.epoch = epoch
        if samples and t_ns <= samples[-1][0]:
            return

        samples.append((t_ns, q))
        while samples[0][0] < t_ns - WINDOW_NS - 4 * MARGIN_NS:
            samples.popleft()

    def add_mocap(self, t_ns: int, frame: MocapFrame, epoch: int = 0) -> None:
        """Add one live mocap frame."""
        if not self._clusters:
            return
        frames = self._frames
        if self._mocap_epoch not in (None, epoch):  # the clock of the frames restarted
            frames.clear()
            self._tracks.clear()
            self._next_ns = None
            for lag in self.sensors.values():
                lag.tracker.widen(RESTART_SD_NS)
        elif frames and (last := frames[-1][1].layout) is not frame.layout and last != frame.layout:
            frames.clear()
            self._tracks.clear()
        self._mocap_epoch = epoch
        if frames and t_ns <= frames[-1][0]:
            return

        frames.append((t_ns, frame))
        while frames[0][0] < t_ns - WINDOW_NS - 2 * MARGIN_NS:
            frames.popleft()
        if self._next_ns is None:
            self._next_ns = t_ns + WINDOW_NS
        elif t_ns >= self._next_ns + MARGIN_NS and not self._waiting and self._window is None:
            self._waiting.extend((sensor, self._next_ns) for sensor in self.sensors)
            self._next_ns = max(self._next_ns + HOP_NS, t_ns - MARGIN_NS)

    # --- estimation --------------------------------------------------------------------------

    def step(self, now_ns: int) -> list[Notice]:
        """Compute for at most a few milliseconds, and return the resulting notices."""
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
            return self._finish(now_ns, window, done.value)
        return []

    def _estimate(self, sensor: str, end_ns: int) -> Generator[None, None, LagEstimate]:
        start_ns = end_ns - WINDOW_NS
        segment = self._segment[sensor]
        if segment not in self._clusters:
            return _no_estimate(
                f"the calibration has no markers on {segment}: calibrate with motion capture"
            )

        # Compute the orientations of the segment, which all of its sensors share.
        track = self._tracks.get(segment)
        if track is None or track.end_ns != end_ns:
            rows = [row for row in self._frames if start_ns <= row[0] <= end_ns]
            if len(rows) < _MIN_FRAMES:
                return _no_estimate("too few mocap frames: check that the system streams")
            t_ref, q_ref = yield from _orientations(self._clusters[segment], rows, track)
            track = _SegmentTrack(end_ns, t_ref, q_ref)
            self._tracks[segment] = track

        # Select the sensor's samples, with a margin for the lag.
        low, high = start_ns - MARGIN_NS, end_ns + MARGIN_NS
        samples = [row for row in self.sensors[sensor].samples if low <= row[0] <= high]
        if len(samples) < _MIN_FRAMES:
            return _no_estimate("too few samples of the sensor: check that it streams")
        t_imu = np.array([row[0] for row in samples], dtype=np.int64)
        q_imu = np.array([row[1] for row in samples], dtype=np.float64)
        yield
        imu = rates_from_orientations(t_imu, q_imu, start_ns)
        yield
        ref = track.rates or rates_from_orientations(track.t_ns, track.q, start_ns)
        self._tracks[segment] = track._replace(rates=ref)
        yield
        return (yield from estimate_in_steps(imu, ref, LagSettings(low_r2=_LOW_R2)))

    def _finish(self, now_ns: int, window: _Window, estimate: LagEstimate) -> list[Notice]:
        name, lag = window.sensor, self.sensors[window.sensor]
        lag.refused = estimate.refused
        lag.tracked = tracked = lag.tracker.feed(window.center_ns, estimate)
        if tracked is None or estimate.refused is not None:
            return []

        # A large change of the lag invalidates the calibration.
        notices, warning = [], NoticeLevel.WARNING
        if (step_ns := tracked.step_ns) is not None:
            kind, level = NoticeKind.CLOCK, NoticeLevel.INFO
            text = f"lag changed by {_ms(step_ns)}: a clock or a filter of the sensor changed"
            if abs(step_ns) > STEP_FAULT_NS:
                kind, level = NoticeKind.CALIBRATION, warning
                text += "; the calibration may be invalid: repeat the functional phase"
            data = {"step_ms": round(step_ns * 1e-6, 3)}
            notices.append(Notice(now_ns, kind, name, text, level, data))

        # Drift between synchronized clocks is reported only once.
        excess = abs(tracked.drift) - DRIFT_FAULT
        drifts = excess > 2.0 * tracked.drift_sigma
        if drifts and not lag.drifted:
            text = (
                f"lag drifts by {1e6 * tracked.drift:.1f} ppm although both clocks are "
                "synchronized: one of the two clock fits is wrong; restart the sensor, then the "
                "mocap server"
            )
            data = {"drift_ppm": round(1e6 * tracked.drift, 2)}
            notices.append(Notice(now_ns, NoticeKind.CLOCK, name, text, warning, data))
        lag.drifted = drifts or (lag.drifted and excess > 0.0)

        # A contradiction between configured and estimated lag is reported only once.
        if (known := self._known.get(name)) is None:
            return notices
        difference = tracked.lag_ns - known.lag_ns
        sigma = float(np.hypot(tracked.sigma_ns, known.sigma_ns))
        before, lag.contradicted = lag.contradicted, abs(difference) > CONTRADICTION_SIGMA * sigma
        if lag.contradicted and not before:
            text = (
                f"lag estimated from motion is {_ms(tracked.lag_ns)}, configured "
                f"{_ms(known.lag_ns)}: {abs(difference) / sigma:.0f} standard deviations apart; "
                "check the sync cable and lag_ms in rig.toml"
            )
            data = {"lag_ms": tracked.lag_ns * 1e-6}
            notices.append(Notice(now_ns, NoticeKind.CLOCK, name, text, warning, data))
        return notices

    # --- output ------------------------------------------------------------------------------

    def known_lags_ns(self) -> dict[str, int]:
        """Return the lags that rig.toml configures, ns."""
        return {name: round(lag.lag_ns) for name, lag in self._known.items()}

    def tracked_lags(self) -> dict[str, tuple[float, float]]:
        """Return the estimated lags and their standard deviations, ns."""
        return {
            name: (lag.tracked.lag_ns, lag.tracked.sigma_ns)
            for name, lag in self.sensors.items()
            if lag.tracked is not None
        }

    def health(self) -> dict[str, LagHealth]:
        """Return the lag in use and the estimated lag of every sensor."""
        found = {}
        for sensor, lag in self.sensors.items():
            if (known := self._known.get(sensor)) is not None:
                found[sensor] = LagHealth(
                    LagSource.CONFIGURED, *known, None, lag.tracked, lag.refused
                )
                continue
            used, quality = self._calibrated.get(sensor), self._quality.get(sensor, {})
            source = LagSource.NONE if used is None else LagSource.CALIBRATION
            sigma, method = quality.get("sigma_ns"), quality.get("source")
            found[sensor] = LagHealth(source, used, sigma, method, lag.tracked, lag.refused)
        return found


def _orientations(
    cluster: MarkerCluster, rows: list[tuple[int, MocapFrame]], before: _SegmentTrack | None
) -> Generator[None, None, tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Return the orientations of a segment from its markers; yield after every few frames.

    Windows overlap, so frames that the window `before` contains are not fitted again.
    """
    t_ns = np.array([t for t, _ in rows], dtype=np.int64)
    layout = rows[0][1].layout
    if cluster.body is not None:
        column = layout.bodies.index(cluster.body) if cluster.body in layout.bodies else None
        missing = np.full(4, np.nan)
        return t_ns, np.array(
            [missing if column is None else frame.body_orientations[column] for _, frame in rows]
        )

    columns = [layout.markers.index(m) if m in layout.markers else -1 for m in cluster.markers]
    parts, fitted = [], 0
    if before is not None:
        fitted = int(np.searchsorted(t_ns, before.t_ns[-1], side="right"))
        parts.append(before.q[len(before.q) - fitted :])
    for start in range(0, len(rows), _FRAMES_PER_STEP):
        new = rows[max(start, fitted) : start + _FRAMES_PER_STEP]
        if new:
            seen = np.stack([frame.markers for _, frame in new])
            # Column -1 contains NaN for markers that are not part of the stream.
            absent = np.full((len(seen), 1, 3), np.nan)
            positions = np.concatenate((seen, absent), axis=1).take(columns, axis=1)
            parts.append(rigid_fit(cluster.template, positions)[0])
        # The results depend on the number of steps. The generator therefore also yields for the
        # frames of `before`, so that this number is the same without `before`.
        yield
    return t_ns, np.concatenate(parts)


def _no_estimate(refused: str) -> LagEstimate:
    return LagEstimate(np.nan, np.inf, np.nan, refused)


def _ms(value_ns: float) -> str:
    return f"{value_ns * 1e-6:.2f} ms"
