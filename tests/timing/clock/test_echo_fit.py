"""Clocks of servers, estimated from answered echoes: simulated echoes and a real capture.

An echo consists of the host times of a request and its reply, and of the server time in between.
"""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.model import ClockEcho, TickClock
from jointfit_daemon.timing.clock import DeviceClock, Stamp

if TYPE_CHECKING:
    from pathlib import Path

MS = 1_000_000
S = 1_000_000_000
PERIOD = 10 * MS
START = 7_000 * S
NO_STAMP = Stamp(0, 0.0, synced=False, epoch=-1)

SERVER_HZ = 3_312_787
SERVER = TickClock(1, None, SERVER_HZ)


class Lan:
    """A server with a skew of 42 ppm, and echoes over a network with varying delays.

    The delay in each direction is 0.43 ms, plus an exponential delay with a mean of 0.1 ms, plus
    20 ms in 1 % of the cases.
    """

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def ticks(self, t: float) -> int:
        return int((t - START + 400 * S) * (1 + 42e-6) * SERVER_HZ / S)

    def echo(self, t: int) -> ClockEcho:
        there, back = 430_000 + self.rng.exponential(1e5, 2) + (self.rng.random(2) < 0.01) * 20e6
        return ClockEcho(t, int(t + there + back), self.ticks(t + there))


@pytest.mark.parametrize("seed", range(10))
def test_echoes_synchronize_the_server_at_once_and_better_later(seed: int) -> None:
    lan, clock = Lan(seed), DeviceClock(PERIOD)
    now, stamp = START, NO_STAMP
    for number in range(70):
        clock.feed_echo(lan.echo(now), SERVER)
        now += 50 * MS if number < 10 else S + int(lan.rng.uniform(-0.2, 0.2) * S)
        stamp = clock.feed_sample(lan.ticks(now), None, now + 6 * MS, SERVER)
        if number >= 9:
            assert stamp.synced
            assert abs(stamp.t_ns - now) < 4 * stamp.sigma_ns
        if number == 9:
            assert abs(stamp.t_ns - now) < 0.1 * MS
            assert stamp.sigma_ns < 50_000
    assert abs(stamp.t_ns - now) < 60_000
    assert stamp.sigma_ns < 20_000
    assert clock.skew_ppm == pytest.approx(-42, abs=1)
    assert clock.bound_ns == pytest.approx(440_000, abs=40_000)
    assert clock.state == "echo"


def test_slow_and_lost_echoes_do_not_move_the_server_clock() -> None:
    lan, all_of_them, some = Lan(3), DeviceClock(PERIOD), DeviceClock(PERIOD)
    for number in range(60):
        echo = lan.echo(START + number * S)
        all_of_them.feed_echo(echo, SERVER)
        if number % 3 != 1:
            delay = 20 * MS if number % 3 else 0
            some.feed_echo(ClockEcho(echo.sent_ns, echo.received_ns + delay, echo.ticks), SERVER)
    now = START + 60 * S
    a, b = (c.feed_sample(lan.ticks(now), 0, now + MS, SERVER) for c in (all_of_them, some))
    assert abs(a.t_ns - b.t_ns) < 50_000


def test_a_server_that_restarts_is_noticed_by_its_echo() -> None:
    lan, clock = Lan(0), DeviceClock(PERIOD)
    for k in range(20):
        clock.feed_echo(lan.echo(START + k * 50 * MS), SERVER)
    clock.feed_echo(ClockEcho(START + S, START + S + MS, 5), SERVER)
    clock.feed_echo(ClockEcho(START + 2 * S, START + 2 * S + MS, 5 + SERVER_HZ), SERVER)
    assert clock.epoch == 1
    assert clock.state == "settling"


@pytest.mark.parametrize("forged", [0, 5, 2**63 * SERVER_HZ // S])
def test_single_forged_echoes_do_not_change_the_clock(forged: int) -> None:
    lan, clean, attacked = Lan(0), DeviceClock(PERIOD), DeviceClock(PERIOD)
    for k in range(40):
        echo = lan.echo(START + k * 200 * MS)
        clean.feed_echo(echo, SERVER)
        attacked.feed_echo(echo, SERVER)
        if k > 10:
            attacked.feed_echo(replace(echo, ticks=forged + k * SERVER_HZ), SERVER)
    assert attacked.epoch == 0
    assert attacked.host_ns(START) == clean.host_ns(START)


def test_echoes_before_the_tick_rate_is_known_are_ignored() -> None:
    clock = DeviceClock(PERIOD)
    clock.feed_echo(ClockEcho(START, START + MS, 5))
    assert clock.bound_ns is None


def test_a_clock_without_fresh_echoes_is_stale() -> None:
    lan, clock = Lan(0), DeviceClock(PERIOD)
    for k in range(20):
        clock.feed_echo(lan.echo(START + k * 50 * MS), SERVER)
    for second in (1, 60):
        clock.feed_sample(lan.ticks(START + second * S), 0, START + second * S + 6 * MS, SERVER)
    assert clock.state == "stale"


@pytest.fixture
def capture(shared_data: Path) -> list[tuple[int, bytes]]:
    """Return UDP payloads to and from the NatNet server with their packet times, ns."""
    file = shared_data / "mocap" / "natnet_v3_mje-nz" / "test_data" / "raw" / "traffic.pcapng"
    data, at, packets = file.read_bytes(), 0, []
    while at < len(data):
        kind, size = struct.unpack_from("<II", data, at)
        if kind == 6:
            high, low, length = struct.unpack_from("<III", data, at + 12)
            packets.append((((high << 32) | low) * 1000, data[at + 28 : at + 28 + length][42:]))
        at += size
    return packets


def test_the_real_capture_gives_its_known_timing(capture: list[tuple[int, bytes]]) -> None:
    clock, passive = DeviceClock(S // 120), DeviceClock(S // 120)
    sent: dict[bytes, int] = {}
    echoes, transits = [], []
    for t, payload in capture:
        (kind,) = struct.unpack_from("<H", payload)
        if kind == 12:
            sent[payload[4:12]] = t
        elif kind == 13:
            (ticks,) = struct.unpack_from("<Q", payload, 12)
            echoes.append(ClockEcho(sent[payload[4:12]], t, ticks))
    for echo in echoes:
        clock.feed_echo(echo, SERVER)
    assert len(echoes) == 9
    clock.feed_echo(echoes[-1], SERVER)  # a tenth echo completes the burst
    for t, payload in capture:
        if struct.unpack_from("<H", payload)[0] == 7:
            (number,) = struct.unpack_from("<i", payload, 4)
            (transmit,) = struct.unpack_from("<Q", payload, len(payload) - 14)
            stamp = clock.feed_sample(transmit, number, t, SERVER)
            transits.append((t - stamp.t_ns) / MS)
            passive.feed_sample(transmit, None, t, SERVER)
    assert len(transits) == 518
    assert clock.skew_ppm == pytest.approx(42, abs=24)
    assert np.median(transits) == pytest.approx(0.693, abs=0.06)
    assert min(transits) == pytest.approx(0.416, abs=0.08)
    assert passive.skew_ppm == pytest.approx(34, abs=25)
