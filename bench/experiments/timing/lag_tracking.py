"""Lag tracking with device clocks that drift.

The daemon's clock models convert device time to host time. The lag is then tracked from the
converted timestamps.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bench.experiments.timing.lag import made_up
from bench.framework.experiment import Experiment, Result
from bench.framework.material import SIMULATED_CLOCKS
from jointfit_daemon.kinematics.rotation_scalar import IDENTITY_ONE, as_quaternion
from jointfit_daemon.limb_model import Calibration, SensorCalibration, StoredCluster
from jointfit_daemon.model import Chain, ClockEcho, MocapFrame, MocapLayout, TickClock
from jointfit_daemon.pipeline.sources import LagMonitor
from jointfit_daemon.timing.clock import DeviceClock

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.model import Quaternion

MS, S = 1_000_000, 1_000_000_000
START = 7_000 * S
MICROSECONDS = TickClock(1000, None)
SERVER = TickClock(100, None)
LEAST_MS = 2.0
"""Delay of the sensor's transport, ms. The clock model cannot detect this delay, so it appears as
the lag."""
CHAIN = Chain(("hip", "knee"), ("thigh",), (("S1",),))
LAYOUT = MocapLayout((), ("thigh",))
CALIBRATION = Calibration(
    method="anchored",
    joints=CHAIN.joints,
    segments=CHAIN.segments,
    chain_sensors=CHAIN.sensors,
    sensor={"S1": SensorCalibration(IDENTITY_ONE, IDENTITY_ONE, 0, 0.0)},
    segment={},
    joint={},
    clusters={"thigh": StoredCluster((), "thigh", (), (0.0, 0.0, 0.0), IDENTITY_ONE)},
)


class Case(NamedTuple):
    """Skews of both clocks, and a drift of the sensor's stamps that its clock cannot detect."""

    sensor_ppm: float
    cameras_ppm: float
    unseen_ppm: float = 0.0


class Found(NamedTuple):
    """Final result of lag tracking."""

    lag_ms: float
    sigma_ms: float
    drift_ppm: float
    drift_sigma_ppm: float
    told: list[str]


class _Stamps:
    """Clock models of sensor and cameras, which receive the same input as in the daemon."""

    def __init__(self, case: Case, seed: int) -> None:
        self._case, self._rng = case, np.random.default_rng(seed)
        self._sensor, self._cameras = DeviceClock(10 * MS), DeviceClock(S // 120)
        self._echo_at, self._echoes = 0.0, 0

    def sensor_ns(self, t_ns: float) -> int:
        case = self._case
        ticks = int(t_ns * (1.0 + 1e-6 * (case.sensor_ppm - case.unseen_ppm)) / 1000)
        arrival = START + int(t_ns + LEAST_MS * MS + self._rng.exponential(3e5))
        stamp = self._sensor.feed_sample(ticks, None, arrival, MICROSECONDS)
        return stamp.t_ns + int(1e-6 * case.unseen_ppm * t_ns) if stamp.synced else -1

    def cameras_ns(self, t_ns: float) -> int:
        if t_ns >= self._echo_at:
            there, back = 430_000 + self._rng.exponential(1e5, 2)
            echo = ClockEcho(
                START + int(t_ns), START + int(t_ns + there + back), self._server(t_ns + there)
            )
            self._cameras.feed_echo(echo, SERVER)
            self._echoes += 1
            self._echo_at = t_ns + (50 * MS if self._echoes < 10 else S)
        arrival = START + int(t_ns) + 6 * MS
        stamp = self._cameras.feed_sample(self._server(t_ns), None, arrival, SERVER)
        return stamp.t_ns if stamp.synced else -1

    def _server(self, t_ns: float) -> int:
        return int((t_ns + 400 * S) * (1.0 + 1e-6 * self._case.cameras_ppm) / 100)


def run(case: Case, seconds: float = 121.0, seed: int = 1) -> Found:
    """Convert the stamps of a moving subject's data, and track the lag; return the final result."""
    tracks, stamps = made_up(seed, seconds, 0.0), _Stamps(case, seed)
    watch, told = LagMonitor(CHAIN, CALIBRATION), []
    events: list[tuple[int, int, Quaternion]] = []
    for kind, times, turned in ((0, tracks.t_imu, tracks.q_imu), (1, tracks.t_ref, tracks.q_ref)):
        events += [
            (t, kind, as_quaternion(row))
            for t, row in zip(times.tolist(), turned.tolist(), strict=True)
        ]
    for number, (t_ns, kind, q) in enumerate(sorted(events)):
        if kind == 0:
            stamp = stamps.sensor_ns(t_ns)
            if stamp >= 0:
                watch.add_sample("S1", stamp, q)
            told += [notice.text for notice in watch.step(START + t_ns)]
            continue
        stamp = stamps.cameras_ns(t_ns)
        frame = MocapFrame(
            t_ns, number, None, LAYOUT, np.zeros((0, 3)), np.zeros((1, 3)), np.array([q])
        )
        if stamp >= 0:
            watch.add_mocap(stamp, frame)
    tracked = watch.sensors["S1"].tracked
    if tracked is None:
        return Found(np.nan, np.nan, np.nan, np.nan, told)
    figures = (tracked.lag_ns / MS, tracked.sigma_ns / MS)
    return Found(*figures, 1e6 * tracked.drift, 1e6 * tracked.drift_sigma, told)


def drifting(_: Path) -> list[Result]:
    """Check that no drift of the lag is found if the clocks differ by 100 ppm.

    In a second case, the stamps have a drift that the clock model cannot detect. The lag tracker
    must detect and report this drift.
    """
    figures = []
    for case in (Case(50.0, -50.0), Case(-50.0, 50.0, 5.0)):
        found = run(case)
        # The lag of the tracker refers to the center of its window, up to 8 s before the end.
        truth = LEAST_MS + 1e-3 * case.unseen_ppm * 114.0
        slack = 1e-3 * abs(case.unseen_ppm) * 2.0
        off = max(0.0, abs(found.lag_ms - truth) - slack)
        label = (
            f"{case.sensor_ppm:+g} and {case.cameras_ppm:+g} ppm, "
            f"{case.unseen_ppm:g} ppm of lag drift"
        )
        estimate = f"estimate {found.drift_ppm:.2f} ± {found.drift_sigma_ppm:.2f} ppm"
        apart = abs(found.drift_ppm - case.unseen_ppm) / found.drift_sigma_ppm
        wanted = 1.0 if case.unseen_ppm else 0.0
        figures += [
            Result(f"{label}: lag error", off, 0.1, unit="ms"),
            Result(f"{label}: drift error", apart, 2.0, unit="sd", note=estimate),
            Result(f"{label}: warnings", float(len(found.told)), wanted, wanted, unit=""),
        ]
    return figures


EXPERIMENTS = (
    Experiment(
        "lag-drift-live",
        "Lag tracked during operation, with clock errors of 50 ppm",
        drifting,
        SIMULATED_CLOCKS,
    ),
)
