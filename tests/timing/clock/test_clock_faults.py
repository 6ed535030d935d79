"""Clock faults: jumps, pauses and wrong stamps are reported; stamps are correct again after 5 s."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointfit_daemon.model import ClockEcho, TickClock
from jointfit_daemon.timing.clock import DeviceClock
from jointfit_daemon.timing.clock._device_time import BACKWARD_LIMIT

if TYPE_CHECKING:
    from jointfit_daemon.timing.clock import Stamp

MS = 1_000_000
S = 1_000_000_000
PERIOD = 10 * MS
START = 7_000 * S
OWN = TickClock(1000, 1 << 32)
HEALED_NS = 5 * S


def longest_run_back(stamps: list[int]) -> int:
    """Return the largest number of successive stamps that are not later than an earlier stamp."""
    newest, now, most = -1, 0, 0
    for t in stamps:
        now = now + 1 if t <= newest else 0
        newest, most = max(newest, t), max(most, now)
    return most


class ClockFaultRun:
    """A streaming device; a test can change its clock, its counter and the host's clock."""

    def __init__(self, seed: int = 0) -> None:
        self.clock = DeviceClock(PERIOD)
        self.rng = np.random.default_rng(seed)
        self.k = 0
        self.ahead_ns = 60 * S
        """Device time minus the time since the start, ns."""
        self.asleep_ns = 0
        """Time during which the host's clock stood still, ns."""
        self.counter = 100
        self.out: list[tuple[int, Stamp]] = []

    def stream(self, seconds: float, *, counted: bool = True) -> None:
        for _ in range(round(seconds * S / PERIOD)):
            since = self.k * PERIOD
            ticks = (since + self.ahead_ns) * 1_000_020 // 1_000_000 // 1000 % (1 << 32)
            true = START + since - self.asleep_ns
            arrival = true + int(self.rng.exponential(3e5))
            counter = self.counter % 65536 if counted else None
            self.out.append((true, self.clock.feed_sample(ticks, counter, arrival, OWN)))
            self.k += 1
            self.counter += 1

    def check(self, since: int, news: str) -> None:
        """Check event and order of stamps; stamps are correct 5 s after sample number `since`."""
        assert longest_run_back([stamp.t_ns for _, stamp in self.out]) < BACKWARD_LIMIT
        for number, (true, stamp) in enumerate(self.out):
            healed = number >= since + HEALED_NS // PERIOD
            assert stamp.synced or not healed
            assert not healed or abs(stamp.t_ns - true) < MS
        told: list[Any] = list(self.clock.news)
        assert any(news in item.text for item in told), told
        assert len(told) == 1


@pytest.mark.parametrize("jump_ms", [-30_000, -3_000, -400, 40, 3_000, 100_000])
def test_a_clock_jump_is_reported_and_stamps_recover(jump_ms: int) -> None:
    run = ClockFaultRun()
    run.stream(12)
    run.ahead_ns += jump_ms * MS
    run.stream(8)
    run.check(1200, "jumped back" if jump_ms < 0 else "jumped ahead")
    assert run.clock.epoch == 1


@pytest.mark.parametrize("counted", [True, False])
def test_a_reboot_within_a_stream_is_reported_as_restart(counted: bool) -> None:
    run = ClockFaultRun()
    run.stream(12, counted=counted)
    run.ahead_ns = -run.k * PERIOD
    run.counter = 0
    run.stream(8, counted=counted)
    run.check(1200, "rebooted")
    assert run.clock.news[0].kind == "restart"


def test_suspend_of_the_host_is_reported_and_stamps_recover() -> None:
    run = ClockFaultRun()
    run.stream(12)
    asleep_s = 40
    run.asleep_ns += asleep_s * S
    run.k += asleep_s * S // PERIOD
    run.counter += asleep_s * S // PERIOD
    run.stream(8)
    run.check(1200, "suspend")
    assert run.clock.epoch == 1


def test_a_server_whose_host_slept_is_found_by_its_frames_and_by_its_echoes() -> None:
    server = TickClock(1, None, 10_000_000)
    clock, stamps = DeviceClock(PERIOD), []
    for k in range(1600):
        slept = 0 if k < 800 else 30 * S
        t = START + k * PERIOD
        if k % 20 == 0:
            clock.feed_echo(ClockEcho(t, t + MS, (t + slept + MS // 2) // 100), server)
        stamps.append((t, clock.feed_sample((t + slept) // 100, None, t + 6 * MS, server)))
    assert clock.epoch == 1
    assert all(abs(stamp.t_ns - t) < MS for t, stamp in stamps[-300:])
    assert clock.state == "echo"


def test_a_counter_jump_is_ignored_where_ticks_continue() -> None:
    run = ClockFaultRun()
    run.stream(8)
    run.counter += 5000
    run.stream(8)
    assert run.clock.epoch == 0
    assert not run.clock.news


def test_an_implausible_skew_is_reported_once() -> None:
    clock = DeviceClock(PERIOD)
    for k in range(4000):
        t = START + k * PERIOD
        clock.feed_sample(k * 10_011, None, t, OWN)  # 1100 ppm fast
    assert [news.kind for news in clock.news] == ["warning"]
    assert "tick rate" in clock.news[0].text


faults = st.lists(
    st.tuples(st.sampled_from(["jump", "boot", "sleep", "twice", "loss"]), st.integers(1, 60_000)),
    min_size=1,
    max_size=3,
)


@settings(max_examples=12, deadline=None)
@given(faults, st.booleans())
def test_stamps_are_monotonic_and_recover_from_any_clock_fault(
    happened: list[tuple[str, int]],
    counted: bool,
) -> None:
    run = ClockFaultRun(1)
    run.stream(3, counted=counted)
    for what, amount in happened:
        if what == "jump":
            run.ahead_ns += (amount - 30_000) * MS
        elif what == "boot":
            run.ahead_ns, run.counter = -run.k * PERIOD, 0
        elif what == "sleep":
            run.asleep_ns += amount // 10 * PERIOD
            run.k += amount // 10
            run.counter += amount // 10
        elif what == "twice":
            run.k -= 1
            run.counter -= 1
        else:
            run.k += amount // 100
            run.counter += amount // 100
        run.stream(0.5, counted=counted)
    run.stream(8, counted=counted)
    stamps = [stamp.t_ns for _, stamp in run.out if not stamp.duplicate]
    assert longest_run_back(stamps) < BACKWARD_LIMIT
    for true, stamp in run.out[-250:]:
        assert stamp.synced
        assert abs(stamp.t_ns - true) < MS


def test_ten_hours_need_constant_memory() -> None:
    """Containers have the same size after ten hours as after two minutes, at 1 sample/s."""
    clock, server = DeviceClock(S), TickClock(1000, 1 << 32)
    sizes = []
    for k in range(36_000):
        t = START + k * S
        clock.feed_sample(k * 1_000_000 % (1 << 32), k % 65536, t + k % 7 * MS, server)
        if k in {150, 35_999}:
            sizes.append(sum(_sizes(clock)))
    assert sizes[1] <= sizes[0] + 2
    assert clock.epoch == 0


def _sizes(thing: Any, depth: int = 4) -> list[int]:
    """Return the lengths of all containers reachable through slots."""
    if depth and hasattr(type(thing), "__slots__") and not isinstance(thing, tuple):
        parts = [getattr(thing, name, None) for name in type(thing).__slots__]
        return [size for part in parts for size in _sizes(part, depth - 1)]
    return [len(thing)] if hasattr(thing, "__len__") else []
