"""Device clock: accuracy of the host times, settling, wraps of counters, and restarts."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.model import ClockEcho, TickClock
from jointfit_daemon.timing.clock import DeviceClock, Stamp

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

MS = 1_000_000
S = 1_000_000_000
PERIOD = 10 * MS
START = 7_000 * S
MICROSECONDS = TickClock(1000, 1 << 32)
NO_STAMP = Stamp(0, 0.0, synced=False, epoch=-1)

Delay: TypeAlias = Callable[[np.random.Generator, int], "NDArray[np.float64]"]


def exponential(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    """Return delays, ns: 0.3 ms on average, and spikes of 5 to 20 ms in 2 % of the samples."""
    spikes = (rng.random(n) < 0.02) * rng.uniform(5e6, 20e6, n)
    return rng.exponential(3e5, n) + spikes


def latency_timer(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    """Return delays, ns, of a USB bridge with a latency timer of 16 ms."""
    return rng.uniform(0, 16e6, n)


def punctual(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    return rng.exponential(2e4, n)


class Device:
    """A device with a clock skew and known true host times of its samples."""

    def __init__(self, seed: int = 0, *, skew: float | None = None, first: int = 1000) -> None:
        self.rng = np.random.default_rng(seed)
        self.skew = float(self.rng.uniform(-50e-6, 50e-6)) if skew is None else skew
        self.first = first

    def samples(
        self, seconds: float, delay: Delay, start: int = START
    ) -> Iterable[tuple[int, int, int, int]]:
        """Yield true host time (ns), device time (µs), counter, and arrival (ns) of each sample."""
        true = start + PERIOD * np.arange(int(seconds * S / PERIOD))
        arrivals = np.maximum.accumulate(true + delay(self.rng, len(true)).astype(np.int64))
        ticks = self.first + ((true - start) / (1 + self.skew) / 1000).astype(np.int64)
        yield from zip(
            true.tolist(), ticks.tolist(), range(len(true)), arrivals.tolist(), strict=True
        )


def errors_of(
    clock: DeviceClock, samples: Iterable[tuple[int, int, int, int]], use: str = "ticks"
) -> tuple[NDArray[np.float64], list[Stamp]]:
    errors, stamps = [], []
    for true, ticks, counter, arrival in samples:
        stamp = clock.feed_sample(
            ticks % (1 << 32) if use == "ticks" else None,
            counter % (1 << 16) if use == "counter" else None,
            arrival,
            MICROSECONDS,
        )
        errors.append(stamp.t_ns - true)
        stamps.append(stamp)
    return np.abs(errors), stamps


def after(errors: NDArray[np.float64], seconds: float) -> float:
    """Return the largest error, ms, in the interval of 1 s that begins at `seconds`."""
    at = int(seconds * S / PERIOD)
    return float(errors[at : at + S // PERIOD].max()) / MS


# --- accuracy ---------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("delay", "ten", "sixty"), [(exponential, 0.05, 0.02), (latency_timer, 0.25, 0.05)]
)
def test_passive_clocks_reach_their_accuracy(
    seed: int, delay: Delay, ten: float, sixty: float
) -> None:
    device, clock = Device(seed), DeviceClock(PERIOD)
    errors, stamps = errors_of(clock, device.samples(62, delay))
    assert after(errors, 10) <= ten
    assert after(errors, 60) <= sixty
    assert clock.skew_ppm == pytest.approx(1e6 * device.skew, abs=2)
    assert clock.state == "passive"
    assert {stamp.epoch for stamp in stamps} == {0}
    assert stamps[-1].sigma_ns < 0.2 * MS


@pytest.mark.parametrize("delay", [exponential, latency_timer])
@pytest.mark.parametrize(("use", "state"), [("counter", "passive"), ("nothing", "arrival")])
def test_devices_without_time_are_stamped_evenly(delay: Delay, use: str, state: str) -> None:
    clock = DeviceClock(10_020_000)  # the nominal period has an error of 2000 ppm
    errors, stamps = errors_of(clock, Device(1).samples(40, delay), use)
    assert errors[1500:].max() <= 0.2 * MS
    assert clock.state == state
    assert stamps[-1].epoch == 0
    assert clock.skew_ppm == pytest.approx(-1996, abs=10)


@pytest.mark.parametrize("seconds", [3, 5])
def test_a_young_clock_does_not_trust_its_slope(seconds: int) -> None:
    """In the first seconds, stamps are accurate although the skew is still uncertain."""
    worst = []
    for seed in range(12):
        errors, _ = errors_of(DeviceClock(PERIOD), Device(seed).samples(6.5, latency_timer))
        worst.append(after(errors, seconds))
    assert float(np.sqrt(np.mean(np.square(worst)))) < 0.25


def test_a_better_estimate_is_slewed_to_and_sigma_contains_the_difference() -> None:
    samples = [(t, u, c, t + (4 if c < 1000 else 1) * MS) for t, u, c, _ in
               Device(13, skew=0.0).samples(12, punctual)]  # fmt: skip
    errors, stamps = errors_of(DeviceClock(PERIOD), samples)
    steps = [b.t_ns - a.t_ns for a, b in pairwise(stamps[990:])]
    # The limit is the slew rate of 500 ppm plus the skew.
    assert max(abs(step - PERIOD) for step in steps) < 800e-6 * PERIOD
    assert errors[-1] < errors[1000]
    assert stamps[1005].sigma_ns > 2.5 * MS


def test_errors_are_consistent_with_sigma() -> None:
    for seed in range(6):
        errors, stamps = errors_of(DeviceClock(PERIOD), Device(seed).samples(12, latency_timer))
        assert all(
            error < 6 * stamp.sigma_ns
            for error, stamp in zip(errors, stamps, strict=True)
            if stamp.synced
        )


def test_a_configured_latency_is_subtracted() -> None:
    late, known = DeviceClock(PERIOD), DeviceClock(PERIOD, latency_ns=MS)
    samples = list(Device(2).samples(3, punctual))
    assert errors_of(late, samples)[1][-1].t_ns - errors_of(known, samples)[1][-1].t_ns == MS


def test_first_stamps_are_usable_and_settling_is_short() -> None:
    errors, stamps = errors_of(DeviceClock(PERIOD), Device(3).samples(6, exponential))
    assert not stamps[0].synced
    assert errors[20:].max() < MS
    assert min(k for k, stamp in enumerate(stamps) if stamp.synced) <= 300
    assert all(stamp.synced for stamp in stamps[300:])


def test_losses_of_a_device_without_time_are_found() -> None:
    samples = [s for s in Device(4).samples(30, exponential) if s[2] not in {1000, 1500, 1501}]
    errors, stamps = errors_of(DeviceClock(PERIOD), samples, "nothing")
    assert errors[1040:1480].max() < MS
    assert errors[1540:].max() < MS
    assert stamps[-1].epoch == 0


# --- wraps ------------------------------------------------------------------------------------


def test_no_stamp_is_off_across_a_wrap_of_ticks() -> None:
    device = Device(5, first=(1 << 32) - 20_000_000)
    errors, stamps = errors_of(DeviceClock(PERIOD), device.samples(30, exponential))
    assert errors[1000:].max() < MS
    assert {stamp.epoch for stamp in stamps} == {0}


@pytest.mark.parametrize("width", [256, 1 << 16])
def test_no_stamp_is_off_across_wraps_of_a_counter(width: int) -> None:
    clock = DeviceClock(PERIOD)
    worst = 0
    for true, _, counter, arrival in Device(6).samples(20, exponential):
        stamp = clock.feed_sample(None, (counter + width - 700) % width, arrival)
        worst = max(worst, abs(stamp.t_ns - true)) if stamp.synced else worst
    assert 0 < worst < MS
    assert clock.epoch == 0


def test_a_clock_that_wraps_at_midnight_is_followed() -> None:
    midnight = TickClock(100_000, 864_000_000)
    clock = DeviceClock(PERIOD)
    for k in range(2000):
        t = START + k * PERIOD
        stamp = clock.feed_sample((864_000_000 - 50_000 + k * 100) % 864_000_000, None, t, midnight)
        assert abs(stamp.t_ns - t) < MS
    assert clock.epoch == 0


def test_a_silence_of_many_wraps_keeps_the_clock() -> None:
    """The device sends nothing for 45 s, and its time wraps every 6.55 s."""
    clock = DeviceClock(PERIOD)
    ticks = TickClock(100_000, 1 << 16)  # wraps after 6.55 s
    samples = [s for s in Device(7, skew=0.0).samples(90, punctual) if not 30 < s[2] / 100 < 75]
    for true, us, _, arrival in samples:
        stamp = clock.feed_sample(us // 100 % (1 << 16), None, arrival, ticks)
        assert abs(stamp.t_ns - true) < MS or not stamp.synced
    assert clock.epoch == 0


# --- restarts ---------------------------------------------------------------------------------


def restarted(first: int, use: str = "ticks", gap: float = 0.4) -> tuple[DeviceClock, list[Stamp]]:
    clock = DeviceClock(PERIOD)
    errors_of(clock, Device(8, first=60_000_000).samples(20, exponential), use)
    again = Device(9, first=first).samples(10, exponential, START + int((20 + gap) * S))
    errors, stamps = errors_of(clock, again, use)
    assert errors[50:].max() < 2 * MS
    return clock, stamps


@pytest.mark.parametrize(
    "first", [0, 10_000, 79_000_000, 81_000_000, 100_000_000, 1 << 30, 3 << 30]
)
def test_clock_is_not_synced_after_a_restart_until_it_has_settled(first: int) -> None:
    clock, stamps = restarted(first)
    assert clock.epoch == 1
    assert not any(stamp.synced for stamp in stamps[:150])
    assert all(stamp.synced for stamp in stamps[400:])  # settled within 4 s


def test_a_counter_reset_is_a_restart() -> None:
    clock, _ = restarted(0, "counter")
    assert clock.epoch == 1


def test_a_clock_that_jumps_while_its_counter_does_not_is_a_restart() -> None:
    clock = DeviceClock(PERIOD)
    for k in range(3000):
        jumped = 300_000 if k >= 2000 else 0  # µs; device time and arrivals jump together
        clock.feed_sample(
            1000 + k * 10_000 + jumped, k, START + k * PERIOD + jumped * 1000, MICROSECONDS
        )
        if k == 2000:
            assert clock.epoch == 1


@pytest.mark.parametrize("stall", [0.5, 2.0, 10.0])
@pytest.mark.parametrize("reopened", [False, True])
def test_backlog_that_ends_while_the_counter_stands_is_no_restart(
    stall: float, reopened: bool
) -> None:
    """The last 20 samples before a pause arrive after it. The counter stands still in the pause."""
    clock, silent = DeviceClock(PERIOD), round(stall * S)
    first = 100 * S // 1000  # the device has run for 100 s
    for k in range(4000):
        late = 3000 <= k < 3020  # sampled before the pause, received together after it
        stood = silent if k >= 3020 else 0
        arrival = START + (3000 * PERIOD + silent + k if late else k * PERIOD + stood)
        if k == 3000 and reopened:
            clock.feed_reopened()
        ticks = first + (k * PERIOD + stood) // 1000
        clock.feed_sample(ticks, k, arrival, MICROSECONDS)
        assert clock.epoch == 0
    assert not clock.news


class SentFrame(NamedTuple):
    """Frame of a server, with number, exposure and arrival, ns since the start."""

    number: int
    exposed_ns: int
    arrived_ns: int


def frames_of_a_paused_server(stall_ns: int, still_late_ns: int) -> list[SentFrame]:
    """Return 2000 frames of a server that pauses for `stall_ns` after frame 1019.

    Frames 1000 to 1039 arrive together after the pause. The exposures of frames 1020 to 1039 begin
    `still_late_ns` before the end of the pause.
    """
    exposed = PERIOD * np.arange(2000)
    exposed[1020:] += stall_ns
    arrived = exposed + 5 * MS
    exposed[1020:1040] -= still_late_ns
    arrived[1000:1040] = 1040 * PERIOD + stall_ns + np.arange(40) * 1000
    return list(map(SentFrame, range(2000), exposed.tolist(), arrived.tolist()))


def clock_of_a_server(
    frames: list[SentFrame], tick_clock: TickClock, *, jump_ns: int = 0, jump_at: int = 1 << 60
) -> DeviceClock:
    """Return the clock of a server that answers ten echoes per second if it has its own clock.

    The server's clock jumps by `jump_ns` at frame `jump_at`. The stamps of the last second are
    checked: their errors must be below 6 ms.
    """
    clock, asked = DeviceClock(PERIOD), 0
    errors = []
    for number, exposed, arrived in frames:
        ahead = 100 * S + (jump_ns if number >= jump_at else 0)
        host = START + arrived
        if tick_clock.scale == "own" and arrived >= asked:
            asked = arrived + 100 * MS
            clock.feed_echo(
                ClockEcho(host - MS, host, (arrived + ahead - MS // 2) // 100), tick_clock
            )
        stamp = clock.feed_sample((exposed + ahead) // 100, number, host, tick_clock)
        errors.append(abs(stamp.t_ns - START - exposed))
    assert max(errors[-100:]) < 6 * MS
    return clock


SERVER = TickClock(1, None, 10_000_000)
PTP = TickClock(1, None, 10_000_000, "unix")


@pytest.mark.parametrize("server", [SERVER, PTP], ids=["echoes", "ptp"])
@pytest.mark.parametrize("stall", [0.5, 4.0, 30.0])
@pytest.mark.parametrize("still_late", [0.0, 0.3])
def test_a_server_that_pauses_and_skips_frames_has_no_clock_jump(
    server: TickClock, stall: float, still_late: float
) -> None:
    """The server sends earlier frames late; the numbers of later frames continue."""
    frames = frames_of_a_paused_server(round(stall * S), round(still_late * stall * S))
    clock = clock_of_a_server(frames, server)
    assert clock.epoch == 0
    assert not clock.news


@pytest.mark.parametrize("received", [0, 100, 400], ids="buffer of {} frames".format)
def test_a_stopped_daemon_sees_no_clock_jump(received: int) -> None:
    """The daemon reads the buffered frames of a stop of 4 s at once; the other frames are lost."""
    frames = [SentFrame(k, k * PERIOD, max(k * PERIOD, 1400 * PERIOD * (k >= 1000)) + 5 * MS)
              for k in range(2400) if not 1000 + received <= k < 1400]  # fmt: skip
    clock = clock_of_a_server(frames, SERVER)
    assert clock.epoch == 0
    assert not clock.news


@pytest.mark.parametrize("jump", [0.2, 4.0, -4.0])
def test_a_jump_of_a_server_is_reported(jump: float) -> None:
    frames = [SentFrame(k, k * PERIOD, k * PERIOD + 5 * MS) for k in range(2000)]
    clock = clock_of_a_server(frames, SERVER, jump_ns=round(jump * S), jump_at=1000)
    assert clock.epoch == 1
    assert "jumped" in clock.news[0].text


@pytest.mark.parametrize("jump", [2.0, 6.0])
def test_a_jump_at_the_end_of_a_pause_is_reported(jump: float) -> None:
    """The jump is reported if it is longer or shorter than the pause of four seconds."""
    frames = frames_of_a_paused_server(4 * S, 0)
    clock = clock_of_a_server(frames, SERVER, jump_ns=round(jump * S), jump_at=1020)
    assert clock.epoch == 1
    assert "jumped" in clock.news[0].text


def test_samples_that_stay_late_are_a_restart_after_two_seconds() -> None:
    """The device and its clock paused for 0.3 s, and no counter reveals the pause."""
    clock = DeviceClock(PERIOD)
    epochs = {}
    for true, ticks, number, arrival in Device(14).samples(20, punctual):
        pause = 300 * MS if number >= 1000 else 0
        stamp = clock.feed_sample(ticks, None, arrival + pause, MICROSECONDS)
        epochs[number] = stamp.epoch
        assert number < 1300 or abs(stamp.t_ns - true - pause) < MS
    assert (epochs[1150], epochs[1250], epochs[1999]) == (0, 1, 1)


def test_a_pause_that_device_time_shares_but_the_counter_does_not_is_no_restart() -> None:
    """During the pause of 4 s, device time advances and the counter stands still."""
    clock = DeviceClock(PERIOD)
    for k in range(3000):
        pause_us = 4_000_000 if k >= 2000 else 0
        t_us = k * 10_000 + pause_us
        clock.feed_sample(1000 + t_us, k, START + t_us * 1000, MICROSECONDS)
    assert clock.epoch == 0
    assert not clock.news


def test_a_gap_shared_by_the_counter_is_no_restart() -> None:
    """Device time and counter both advance during the gap."""
    clock = DeviceClock(PERIOD)
    samples = [s for s in Device(8).samples(30, punctual) if not 900 < s[2] < 1400]
    for true, ticks, counter, arrival in samples:
        stamp = clock.feed_sample(ticks, counter % 256, arrival, MICROSECONDS)
        assert not stamp.synced or abs(stamp.t_ns - true) < MS
    assert clock.epoch == 0


def test_stale_bytes_before_fresh_ones_do_not_spoil_the_clock() -> None:
    """Samples from a full buffer, which are minutes old, arrive first and at once."""
    device = Device(10)
    samples = list(device.samples(200, punctual))
    stale = [(t, u, c, START + 195 * S + c * 1000) for t, u, c, _ in samples[:40]]
    clock, stamp = DeviceClock(PERIOD), NO_STAMP
    for true, ticks, counter, arrival in stale + samples[-500:]:
        stamp = clock.feed_sample(ticks, counter, arrival, MICROSECONDS)
        assert not stamp.synced or abs(stamp.t_ns - true) < MS
    assert stamp.synced
    assert clock.epoch == 0


def test_a_restart_reported_by_the_decoder_is_one() -> None:
    clock = DeviceClock(PERIOD)
    errors_of(clock, Device(11).samples(5, punctual))
    clock.feed_restart()
    clock.feed_restart()  # no sample in between, so no second restart
    assert clock.epoch == 1
    assert clock.state == "settling"
    assert clock.skew_ppm is None


def test_the_same_ticks_twice_are_a_duplicate_and_old_ones_are_in_the_past() -> None:
    clock = DeviceClock(PERIOD)
    first, second = (
        clock.feed_sample(t, None, START + t * 1000, MICROSECONDS) for t in (0, 10_000)
    )
    again = clock.feed_sample(10_000, None, START + 11 * MS, MICROSECONDS)
    assert (again.t_ns, again.duplicate) == (second.t_ns, True)
    between = clock.feed_sample(5_000, None, START + 12 * MS, MICROSECONDS)
    assert first.t_ns < between.t_ns < second.t_ns


def test_samples_that_lack_their_time_now_and_then_are_not_synced() -> None:
    clock = DeviceClock(PERIOD)
    for true, ticks, counter, arrival in Device(12).samples(10, punctual):
        absent = counter % 50 == 49
        stamp = clock.feed_sample(None if absent else ticks, None, arrival, MICROSECONDS)
        assert abs(stamp.t_ns - true) < MS
        assert not (absent and stamp.synced)
    assert clock.epoch == 0


# --- whatever comes ---------------------------------------------------------------------------

inputs = st.tuples(
    st.none() | st.integers(0, (1 << 32) - 1) | st.integers(0, 100_000),
    st.none() | st.integers(0, 300),
    st.integers(0, 20 * MS) | st.integers(0, 10**12),
)


@given(st.lists(inputs, max_size=60))
def test_mapped_time_is_monotonic(
    samples: list[tuple[int | None, int | None, int]],
) -> None:
    clock, arrival, newest = DeviceClock(PERIOD), START, 0
    for ticks, counter, wait in samples:
        arrival += wait
        stamp = clock.feed_sample(ticks, counter, arrival, MICROSECONDS)
        assert stamp.sigma_ns >= 0
        if stamp.t_ns > newest:
            newest = stamp.t_ns
        elif not stamp.duplicate:  # only an older device time may give an older stamp
            assert ticks is not None or counter is not None


@given(st.integers(0, 2**31), st.floats(-400e-6, 400e-6))
def test_stamps_grow_with_device_time(seed: int, skew: float) -> None:
    _, stamps = errors_of(DeviceClock(PERIOD), Device(seed, skew=skew).samples(4, latency_timer))
    assert all(a.t_ns < b.t_ns for a, b in pairwise(stamps))
