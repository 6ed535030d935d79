"""Direct time is used unless the arrival times contradict it.

Direct time comes from the edges of a sync line, or from a device clock that is declared to show
host time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.model import ClockEcho, TickClock
from jointfit_daemon.timing.clock import DeviceClock, Edge, SyncLine
from jointfit_daemon.timing.clock._direct_time import EDGE_SD_NS, SyncEdgeFit

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_daemon.timing.clock import Stamp

MS = 1_000_000
S = 1_000_000_000
START = 7_000 * S
OWN = TickClock(1000, 1 << 32)
CAMERA = TickClock(1, None, 10_000_000)
FRAME = S // 120
IMU = 10 * MS


class Wired:
    """A camera server that answers echoes, and an IMU that receives an edge at every exposure."""

    def __init__(self, seed: int = 0, *, least_delay_ms: float = 2.2, off_line_ns: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        self.server = DeviceClock(FRAME)
        self.imu = DeviceClock(IMU, latency_ns=MS, latency_sd_ns=MS)
        self.line = SyncLine()
        self.least = round(least_delay_ms * MS)
        self.off_line = off_line_ns
        self.stamps: list[tuple[int, Stamp]] = []
        """True instant and stamp of the IMU samples, ns."""
        self.frames: list[tuple[int, Stamp]] = []

    def camera_ticks(self, t: int) -> int:
        return int((t - START + 900 * S) * (1 - 30e-6) / 100)

    def imu_ticks(self, t: int) -> int:
        return int((t - START + 50 * S) * (1 + 45e-6) / 1000)

    def run(self, seconds: float, *, begin: float = 0.0, pulses: bool = True) -> None:
        for _, what, t in sorted(self.events(begin, begin + seconds, pulses=pulses)):
            getattr(self, what)(t)

    def events(self, begin: float, end: float, *, pulses: bool) -> Iterator[tuple[int, str, int]]:
        for t in range(START + int(begin * S), START + int(end * S), FRAME):
            yield t + 7 * MS, "frame", t
            if pulses:
                yield t + 3 * MS, "edge", t
        for t in range(START + int(begin * S), START + int(end * S), IMU):
            yield t + self.least, "sample", t
        for t in range(START + int(begin * S), START + int(end * S), S // 4):
            yield t + 2 * MS, "echo", t

    def echo(self, t: int) -> None:
        there, back = 200_000 + self.rng.exponential(5e4, 2)
        echo = ClockEcho(t, int(t + there + back), self.camera_ticks(int(t + there)))
        self.server.feed_echo(echo, CAMERA)

    def frame(self, t: int) -> None:
        stamp = self.server.feed_sample(self.camera_ticks(t), None, t + 7 * MS, CAMERA)
        self.frames.append((t, stamp))
        u = self.server.last_u
        if stamp.synced and u is not None:
            self.line.instant(Edge(self.server.host_ns(u), u))
            self._tie()

    def edge(self, t: int) -> None:
        u = self.imu.edge_ns(self.imu_ticks(t + self.off_line), OWN)
        if u is not None and self.imu.settled:
            self.line.pulse("imu", Edge(self.imu.host_ns(u), u))
            self._tie()

    def _tie(self) -> None:
        for u, v in self.line.match_edges("imu"):
            self.imu.feed_sync_edge(u, v, self.server)

    def sample(self, t: int) -> None:
        delay = self.least + int(self.rng.exponential(3e5))
        self.stamps.append((t, self.imu.feed_sample(self.imu_ticks(t), None, t + delay, OWN)))

    def imu_errors_us(self, last: int) -> np.ndarray:
        return np.array([stamp.t_ns - t for t, stamp in self.stamps[-last:]]) / 1e3

    def frame_errors_us(self, last: int) -> np.ndarray:
        return np.array([stamp.t_ns - t for t, stamp in self.frames[-last:]]) / 1e3


def test_edges_remove_the_smallest_delay_to_a_few_microseconds() -> None:
    wired = Wired(least_delay_ms=2.2)
    wired.run(20.0, pulses=False)
    assert wired.imu.state == "passive"
    # The passive clock subtracts an assumed delay of 1 ms from the smallest delay of 2.2 ms.
    assert np.mean(wired.imu_errors_us(100)) == pytest.approx(1200, abs=30)
    wired.run(20.0, begin=20.0)
    assert wired.imu.state == "direct"
    assert wired.imu.epoch == 0
    between = np.mean(wired.imu_errors_us(100)) - np.mean(wired.frame_errors_us(100))
    assert abs(between) < 3.0  # the error of the echoes is common to both streams
    assert wired.stamps[-1][1].sigma_ns < 30_000


def test_from_passive_to_direct_time_neither_jumps_nor_runs_backwards() -> None:
    wired = Wired()
    wired.run(6.0, pulses=False)
    wired.run(6.0, begin=6.0)
    t = np.array([stamp.t_ns for _, stamp in wired.stamps])
    assert np.all(np.diff(t[400:]) > 0.999 * IMU)
    assert {stamp.epoch for _, stamp in wired.stamps} == {0}


def test_without_edges_the_clock_falls_back_to_arrivals() -> None:
    wired = Wired()
    wired.run(12.0)
    assert wired.imu.state == "direct"
    wired.run(26.0, begin=12.0, pulses=False)
    assert wired.imu.state == "passive"
    assert wired.imu.epoch == 0


def test_a_server_restart_invalidates_sync_fits_until_new_edges_arrive() -> None:
    wired = Wired()
    wired.run(8.0)
    wired.server.feed_restart()
    wired.run(0.2, begin=8.0, pulses=False)
    assert wired.imu.state == "passive"
    wired.run(6.0, begin=8.2)
    assert wired.imu.state == "direct"
    assert abs(np.mean(wired.imu_errors_us(50)) - np.mean(wired.frame_errors_us(50))) < 5.0


def test_edges_half_a_frame_off_are_ambiguous_and_unused() -> None:
    wired = Wired(off_line_ns=FRAME // 2, least_delay_ms=1.0)
    wired.run(8.0)
    assert wired.imu.state == "passive"
    assert wired.line.unmatched > 300


def test_a_declared_clock_is_used_at_once_and_needs_no_arrivals() -> None:
    clock = DeviceClock(IMU, latency_ns=MS, latency_sd_ns=MS)
    host = TickClock(1, None, None, "monotonic")
    for k in range(300):
        t = START + k * IMU
        stamp = clock.feed_sample(t, None, t + 2 * MS, host)
        assert stamp.t_ns == t
        assert stamp.synced
    assert clock.state == "direct"


def test_a_clock_declared_to_show_unix_time_follows_the_offset_of_the_host() -> None:
    clock, unix = DeviceClock(IMU), TickClock(1, None, None, "unix")
    offset = 1_700_000_000 * S
    clock.feed_unix_offset(offset)
    for k in range(300):
        t = START + k * IMU
        assert clock.feed_sample(t + offset, None, t + MS, unix).t_ns == t
    assert clock.state == "direct"


def test_a_declared_clock_that_arrivals_contradict_is_an_event_and_not_used() -> None:
    clock = DeviceClock(IMU)
    host = TickClock(1, None, None, "monotonic")
    for k in range(600):
        t = START + k * IMU
        clock.feed_sample(t - 40 * MS, None, t + MS, host)  # the device clock is 40 ms slow
    assert clock.state == "passive"
    assert [news.kind for news in clock.news] == ["warning", "clock"]
    assert "sync time differs" in clock.news[0].text


class HostClock:
    """A reference clock without error."""

    epoch, slope, settled = 0, 0.0, True

    def host_ns(self, u: int) -> int:
        return u

    def sigma_at(self, u: int) -> float:  # noqa: ARG002 - the same at all times
        return 0.0


@pytest.mark.parametrize("grain_ns", [0.0, 10_000.0, 1_000_000.0])
def test_sigma_of_a_sync_fit_contains_the_quantization_of_the_ticks(grain_ns: float) -> None:
    """The error of rounding to a tick is uniform; its variance is the tick squared over 12."""
    fit, edges = SyncEdgeFit(HostClock(), grain_ns), 9
    for k in range(edges):
        fit.feed(k * S, START + k * S)
    middle = edges // 2 * S  # in the middle, the slope does not contribute
    expected = np.sqrt((EDGE_SD_NS**2 + grain_ns**2 / 12) / edges)
    assert fit.sigma_at(middle) == pytest.approx(expected, rel=1e-6)
