"""Aligner: frames at fixed times from late, lossy, fast, slow, restarted or silent streams."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from math import cos, sin
from random import Random
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.timing.alignment import AlignedFrame, FrameAligner
from jointfit_daemon.timing.alignment._frame_aligner import SampleOutcome

if TYPE_CHECKING:
    from collections.abc import Iterable

MS = 1_000_000
T0 = 5_000 * MS
IDENTITY = (1.0, 0.0, 0.0, 0.0)
VERDICTS = [verdict.value for verdict in SampleOutcome]

Push = tuple[int, str, int]
"""Arrival time (ns), name of the stream, and stamp (ns) of a sample."""


def turned(t_ns: int, rate: float = 2.0) -> tuple[float, float, float, float]:
    """Return the orientation of a body that turns about x at a constant rate, rad/s."""
    half = rate * (t_ns - T0) * 1e-9 / 2
    return (cos(half), sin(half), 0.0, 0.0)


def stream(
    name: str, period: int, count: int, *, phase: int = 0, delay: int = 0, lost: Iterable[int] = ()
) -> list[Push]:
    gone = set(lost)
    stamps = (T0 + phase + k * period for k in range(count) if k not in gone)
    return [(t + delay, name, t) for t in stamps]


def play(aligner: FrameAligner, pushes: list[Push]) -> list[AlignedFrame]:
    """Push samples in order of arrival, and advance at every deadline, as the daemon does."""
    frames: list[AlignedFrame] = []
    for arrival, name, t in sorted(pushes):
        while (deadline := aligner.next_deadline_ns) is not None and deadline < arrival:
            frames += aligner.advance(deadline)
        aligner.push(name, t, arrival, turned(t))
        frames += aligner.advance(arrival)
    return frames


def aligner(period: int = 10 * MS, mode: str = "smooth", **periods: int) -> FrameAligner:
    return FrameAligner(periods, period, mode="fast" if mode == "fast" else "smooth")


def assert_accounted(of: FrameAligner, name: str) -> dict[str, int]:
    counts = of.counts(name)
    assert counts["received"] == counts["pending"] + sum(counts[v] for v in VERDICTS)
    return counts


def test_frames_are_interpolated_to_multiples_of_the_period() -> None:
    a = aligner(A=10 * MS, B=7 * MS)
    frames = play(a, stream("A", 10 * MS, 50, phase=3 * MS) + stream("B", 7 * MS, 70, phase=MS))
    assert [f.t_ns for f in frames] == list(range(T0 + 10 * MS, frames[-1].t_ns + 1, 10 * MS))
    assert len(frames) > 45
    for frame in frames:
        assert not frame.extrapolated
        assert not frame.missing
        for q in frame.orientations.values():
            assert q == pytest.approx(turned(frame.t_ns), abs=1e-12)


def test_a_frame_leaves_with_the_sample_that_completes_it() -> None:
    a = aligner(A=10 * MS, B=10 * MS)
    pushes = stream("A", 10 * MS, 50, phase=3 * MS) + stream(
        "B", 10 * MS, 50, phase=6 * MS, delay=MS
    )
    for frame in play(a, pushes):
        assert frame.completed_ns == frame.t_ns + 7 * MS  # B's next sample: 6 ms later, delay 1 ms


@pytest.mark.parametrize("lost", [[40], [40, 41], [40, 41, 42, 43]])
@pytest.mark.parametrize("phase", [0, 1, 5 * MS, 9 * MS])
def test_missing_samples_delay_a_frame_by_one_and_a_half_periods_at_most(
    lost: list[int], phase: int
) -> None:
    whole = stream("A", 10 * MS, 90) + stream("B", 10 * MS, 90, phase=phase, delay=2 * MS)
    holes = stream("A", 10 * MS, 90) + stream(
        "B", 10 * MS, 90, phase=phase, delay=2 * MS, lost=lost
    )
    usual = {f.t_ns: f.completed_ns for f in play(aligner(A=10 * MS, B=10 * MS), whole)}
    frames = play(aligner(A=10 * MS, B=10 * MS), holes)
    delays = [f.completed_ns - usual[f.t_ns] for f in frames if f.t_ns in usual]
    assert len(frames) >= len(usual)
    assert min(delays) >= 0
    assert 5 * MS < max(delays) <= 15 * MS


def test_missing_samples_delay_a_frame_by_the_same_bound_if_the_period_is_not_nominal() -> None:
    period = 10_200_000
    lost = [first + more for first in range(20, 300, 7) for more in range(3)]
    for phase in range(0, 10 * MS, 900_000):
        usual = play(aligner(B=10 * MS), stream("B", period, 300, phase=phase))
        frames = play(aligner(B=10 * MS), stream("B", period, 300, phase=phase, lost=lost))
        went = {f.t_ns: f.completed_ns for f in usual}
        assert max(f.completed_ns - went[f.t_ns] for f in frames if f.t_ns in went) <= 15 * MS


def test_a_constantly_late_stream_does_not_force_frames() -> None:
    a = aligner(A=10 * MS, B=10 * MS)
    frames = play(a, stream("A", 10 * MS, 200) + stream("B", 10 * MS, 200, phase=MS, delay=48 * MS))
    assert not any(frame.extrapolated for frame in frames)
    assert len(frames) > 190
    assert not any(f.missing for f in frames[10:])


def test_a_stream_that_becomes_late_is_waited_for_after_a_while() -> None:
    a = aligner(A=10 * MS, B=10 * MS)
    early = stream("B", 10 * MS, 100, delay=MS)
    late = stream("B", 10 * MS, 300, phase=1000 * MS, delay=31 * MS)
    frames = play(a, stream("A", 10 * MS, 400) + early + late)
    assert any(f.extrapolated or f.missing for f in frames[100:150])
    assert not any(f.extrapolated or f.missing for f in frames[200:390])


def test_absent_samples_are_extrapolated_then_missing_then_not_awaited() -> None:
    a = aligner(A=10 * MS, B=10 * MS)
    frames = play(a, stream("A", 10 * MS, 100) + stream("B", 10 * MS, 51, phase=0))
    of = {(f.t_ns - T0) // MS: f for f in frames}
    for late in (510, 520):
        assert of[late].extrapolated == {"B"}
        assert of[late].orientations["B"] == pytest.approx(turned(of[late].t_ns), abs=1e-12)
    assert of[530].missing == {"B"}
    assert "B" not in of[530].orientations
    assert of[600].completed_ns == of[600].t_ns  # the stream is lost, so the frame does not wait
    assert a.next_deadline_ns is not None


def test_a_lost_stream_is_back_with_its_second_sample() -> None:
    a = aligner(A=10 * MS, B=10 * MS)
    pushes = stream("A", 10 * MS, 100) + stream("B", 10 * MS, 100, phase=2 * MS, lost=range(30, 60))
    of = {(f.t_ns - T0) // MS: f for f in play(a, pushes)}
    assert of[600].missing == {"B"}
    assert not of[610].missing
    assert not of[610].extrapolated


def test_a_source_that_ends_is_not_waited_for() -> None:
    a = aligner(A=10 * MS, B=10 * MS)
    play(a, stream("A", 10 * MS, 20) + stream("B", 10 * MS, 20))
    a.lose("B")
    t = T0 + 200 * MS
    a.push("A", t, t, turned(t))
    assert [f.t_ns for f in a.advance(t)] == [t]


@pytest.mark.parametrize("delay", [MS, 9 * MS, 38 * MS])
def test_fast_mode_is_one_period_earlier_and_never_ahead_of_time(delay: int) -> None:
    pushes = stream("A", 10 * MS, 100, phase=3 * MS, delay=4 * MS)
    pushes += stream("B", 10 * MS, 100, phase=5 * MS, delay=delay)
    smooth, fast = aligner(A=10 * MS, B=10 * MS), aligner(mode="fast", A=10 * MS, B=10 * MS)
    waited = {f.t_ns: f.completed_ns - f.t_ns for f in play(smooth, pushes)}
    frames = play(fast, pushes)[5:-5]
    for f in frames:
        assert f.completed_ns - f.t_ns == max(0, waited[f.t_ns] - 10 * MS)
        assert f.orientations["A"] == pytest.approx(turned(f.t_ns), abs=1e-12)
    assert assert_accounted(fast, "A")["late"] == 0


def test_a_stream_faster_than_the_frames_is_decimated() -> None:
    a = aligner(A=2_500_000)
    play(a, stream("A", 2_500_000, 400, phase=MS))
    counts = assert_accounted(a, "A")
    assert counts["decimated"] == pytest.approx(100, abs=4)
    assert counts["used"] == pytest.approx(298, abs=4)  # per frame: two neighbors, one before


def test_a_slow_stream_is_interpolated_between_its_samples() -> None:
    a = aligner(A=10 * MS, B=40 * MS)
    frames = play(a, stream("A", 10 * MS, 100) + stream("B", 40 * MS, 25, phase=MS))
    assert not any(frame.extrapolated for frame in frames)
    for f in frames[10:90]:
        assert f.orientations["B"] == pytest.approx(turned(f.t_ns), abs=1e-12)


def test_the_same_stamp_twice_is_a_duplicate() -> None:
    a = aligner(A=10 * MS)
    a.push("A", T0, T0, IDENTITY)
    assert a.push("A", T0, T0 + MS, IDENTITY) is SampleOutcome.DUPLICATE


def test_a_reordered_sample_takes_its_place_and_a_late_one_does_not() -> None:
    a = aligner(A=10 * MS)
    for t in (0, 10, 30):
        a.push("A", T0 + t * MS, T0 + t * MS, turned(T0 + t * MS))
    assert a.push("A", T0 + 20 * MS, T0 + 31 * MS, turned(T0 + 20 * MS)) is None
    a.advance(T0 + 40 * MS)
    assert a.push("A", T0 + 15 * MS, T0 + 41 * MS, IDENTITY) is SampleOutcome.LATE


def test_a_frame_does_not_remember_neighbors_that_a_reordered_sample_parted() -> None:
    """If a reordered sample falls between two samples, earlier frames do not affect later ones."""
    found = []
    for frames_before in (3, 0):  # 3: a frame at 0 ms, and two frames between samples
        a = aligner(A=10 * MS)
        for t, rate in ((0, 2.0), (29, 2.0), (22, 9.0), (39, 2.0)):
            if t == 22:
                assert len(a.advance(T0 + 29 * MS if frames_before else T0 - 1)) == frames_before
            a.push("A", T0 + t * MS, T0 + max(t, 29) * MS, turned(T0 + t * MS, rate))
        found.append(a.advance(T0 + 39 * MS)[-1])
    assert found[0].t_ns == T0 + 30 * MS
    assert found[0].orientations == found[1].orientations


def test_frames_without_orientations_go_on_while_all_streams_are_silent() -> None:
    a = aligner(A=10 * MS, B=10 * MS)
    pushes = [
        *stream("A", 10 * MS, 300, phase=MS, delay=3 * MS, lost=range(100, 200)),
        *stream("B", 10 * MS, 300, phase=4 * MS, delay=2 * MS, lost=range(100, 200)),
    ]
    frames = play(a, pushes)
    assert [f.t_ns for f in frames] == list(range(T0 + 10 * MS, frames[-1].t_ns + 1, 10 * MS))
    of = {(f.t_ns - T0) // MS: f for f in frames}
    assert all(not f.missing for t, f in of.items() if t < 1000 or t > 2010)
    silent = [f for t, f in of.items() if 1010 < t < 1990]
    assert all(f.missing == {"A", "B"} and not f.orientations for f in silent)
    assert all(f.synced for f in silent)  # silent streams have not ended
    waited = [f.completed_ns - f.t_ns for f in silent]
    assert waited[0] == 26 * MS  # B is lost 50 ms after its last sample, A earlier
    assert set(waited[1:]) == {17_500_000}  # usual delay of A, 3 ms, plus 1.45 periods
    assert a.skipped_frames == 0
    for name in "AB":
        assert assert_accounted(a, name)["dropped"] == 0


def test_frames_begin_before_any_stream_does() -> None:
    a = FrameAligner({"A": 10 * MS}, 10 * MS, begin_ns=T0 - 99 * MS)
    frames = play(a, stream("A", 10 * MS, 20, phase=2 * MS))
    assert [f.t_ns for f in frames] == list(range(T0 - 90 * MS, frames[-1].t_ns + 1, 10 * MS))
    early = [f for f in frames if f.t_ns <= T0]
    assert all(f.missing == {"A"} and not f.synced for f in early)
    assert all("A" in f.orientations for f in frames if f.t_ns > T0 + 10 * MS)


def test_a_closed_stream_leaves_frames_unsynced() -> None:
    a = aligner(A=10 * MS)
    play(a, stream("A", 10 * MS, 20))
    a.lose("A")
    frames = a.advance(T0 + 500 * MS)
    assert [f.synced for f in frames if not f.orientations] == [False] * (len(frames) - 2)
    assert frames[-1].t_ns >= T0 + 480 * MS


def test_no_frame_comes_before_its_instant_when_all_streams_end() -> None:
    a = aligner(A=10 * MS, B=10 * MS)
    play(a, stream("A", 10 * MS, 20, delay=MS) + stream("B", 10 * MS, 20, delay=MS))
    for name in ("A", "B"):
        a.lose(name)
    for now_ns in range(T0 + 191 * MS, T0 + 260 * MS, MS):
        assert all(f.t_ns <= f.completed_ns <= now_ns for f in a.advance(now_ns))


def test_frames_that_are_overdue_for_long_are_skipped() -> None:
    a = aligner(A=10 * MS)
    month = 30 * 86_400_000 * MS
    for k in range(50):
        a.push("A", T0 + k * 10 * MS, T0 + k * 10 * MS, IDENTITY)
    last = a.advance(T0 + 490 * MS)[-1]
    a.push("A", T0 + month, T0 + month, IDENTITY)
    frames = a.advance(T0 + month)
    assert last.t_ns < frames[0].t_ns
    assert len(frames) < 110
    assert a.skipped_frames == pytest.approx(month / (10 * MS) - 150, abs=5)


@pytest.mark.parametrize("delay", [300 * MS, 2_000 * MS])
def test_a_stream_that_is_always_late_is_waited_for_while_it_is_the_only_one(delay: int) -> None:
    frames = play(aligner(A=10 * MS), stream("A", 10 * MS, 300, phase=2 * MS, delay=delay))
    assert all(frame.orientations for frame in frames[2:])  # the first frames have one sample
    assert len(frames) > 290


def test_frames_are_not_interpolated_across_an_epoch() -> None:
    a, other = aligner(A=10 * MS), (0.0, 1.0, 0.0, 0.0)
    seen = []
    for k in range(20):
        t = T0 + k * 10 * MS + 4 * MS
        a.push("A", t, t, IDENTITY if k < 10 else other, epoch=k // 10)
        seen += [frame.orientations.get("A") for frame in a.advance(t)]
    assert len(seen) > 15
    assert seen.count(None) == 1
    assert set(seen) == {IDENTITY, None, other}
    assert assert_accounted(a, "A")["dropped"] <= 2


def test_frames_are_not_interpolated_across_a_gap() -> None:
    """A is late, so B's next sample has arrived when the frames of B's gap are output."""
    a = aligner(A=10 * MS, B=10 * MS)
    pushes = stream("A", 10 * MS, 100, delay=120 * MS)
    pushes += stream("B", 10 * MS, 100, phase=MS, delay=MS, lost=range(50, 58))
    of = {(f.t_ns - T0) // MS: f for f in play(a, pushes)}
    missing = [t for t, f in of.items() if "B" in f.missing and t > 100]
    assert missing == [520, 530, 540, 550, 560, 570, 580]
    assert of[510].extrapolated == {"B"}


def test_samples_that_come_when_their_frames_are_out_are_late() -> None:
    a = aligner(A=10 * MS, B=10 * MS)
    play(a, stream("A", 10 * MS, 40) + stream("B", 10 * MS, 10))
    for t in range(T0 + 101 * MS, T0 + 390 * MS, 10 * MS):
        assert a.push("B", t, T0 + 391 * MS, turned(t)) is None
    a.push("A", T0 + 400 * MS, T0 + 400 * MS, IDENTITY)
    a.push("B", T0 + 401 * MS, T0 + 401 * MS, IDENTITY)
    a.advance(T0 + 402 * MS)
    assert assert_accounted(a, "B")["late"] >= 26


def test_a_stamp_from_the_future_is_dropped() -> None:
    a = aligner(A=10 * MS)
    assert a.push("A", T0 + 3_600_000 * MS, T0, IDENTITY) is SampleOutcome.DROPPED


def test_a_stamp_long_before_its_arrival_makes_no_frame() -> None:
    a = aligner(A=10 * MS)
    assert a.push("A", T0 - 60_000 * MS, T0, IDENTITY) is SampleOutcome.LATE
    assert a.advance(T0 + 1000 * MS) == []


def test_a_stream_stamped_seconds_late_does_not_hold_up_the_others() -> None:
    a = aligner(A=10 * MS, B=10 * MS)
    frames = play(a, stream("A", 10 * MS, 300) + stream("B", 10 * MS, 300, delay=2_000 * MS))
    lively = [f for f in frames if "A" in f.orientations and f.t_ns < T0 + 2_900 * MS]
    assert max(f.completed_ns - f.t_ns for f in lively[60:]) < 300 * MS


def test_unfetched_samples_are_dropped_eventually() -> None:
    a = aligner(A=10 * MS)
    for k in range(5_000):
        a.push("A", T0 + k * 10 * MS, T0 + k * 10 * MS, IDENTITY)
    counts = assert_accounted(a, "A")
    assert counts["pending"] <= 512
    assert counts["dropped"] >= 4_400


def test_unsettled_clocks_mark_the_frame() -> None:
    a = aligner(A=10 * MS)
    for k in range(6):
        t = T0 + k * 10 * MS + MS
        a.push("A", t, t, IDENTITY, synced=k > 2)
    assert [f.synced for f in a.advance(T0 + 60 * MS)] == [False, False, False, True, True]


samples = st.tuples(
    st.sampled_from(["A", "B", "C"]),
    st.integers(-30 * MS, 60 * MS)
    | st.integers(-(10**13), 10**13)
    | st.sampled_from([0, 10 * MS]),  # stamp minus previous stamp
    st.integers(0, 40 * MS) | st.integers(0, 10**11),  # arrival minus previous arrival
    st.integers(0, 2) | st.just(0),  # epoch
)
actions = st.one_of(
    samples,
    samples,
    samples,
    st.sampled_from(["lose", "reset", "close"]),
)


@given(st.lists(actions, max_size=80), st.sampled_from(["smooth", "fast"]))
def test_frames_are_ordered_and_samples_accounted_for_any_input(
    script: list[tuple[str, int, int, int] | str], mode: str
) -> None:
    a = aligner(mode=mode, A=10 * MS, B=2_500_000, C=33 * MS)
    now, stamp, last = T0, dict.fromkeys("ABC", T0), -(10**15)
    counted = dict.fromkeys("ABC", 0)
    frames: list[AlignedFrame] = []
    for action in script:
        if isinstance(action, str):
            if action == "close":
                a.close()
            else:
                {"lose": a.lose, "reset": a.reset}[action]("A")
        else:
            name, step, wait, epoch = action
            now += wait
            stamp[name] += step
            counted[name] += 1
            a.push(name, stamp[name], now, IDENTITY, epoch=epoch)
        new = a.advance(now)
        assert len(new) <= 3_000
        frames += new
        deadline = a.next_deadline_ns
        assert deadline is None or deadline > now
        for name in "ABC":
            assert assert_accounted(a, name)["received"] == counted[name]
    for frame in frames:
        assert frame.t_ns > last
        assert frame.t_ns % (10 * MS) == 0
        assert frame.orientations.keys() | frame.missing == {"A", "B", "C"}
        assert frame.completed_ns <= now
        assert not frame.missing & frame.orientations.keys()
        last = frame.t_ns
    a.close()
    assert all(assert_accounted(a, name)["pending"] == 0 for name in "ABC")


# --- streams as devices send them -----------------------------------------------------------------

streams = st.fixed_dictionaries(
    {
        "period": st.sampled_from([2_500_000, 5 * MS, 8_333_333, 10 * MS, 16_666_667, 40 * MS]),
        "phase": st.integers(0, 40 * MS),
        "delay": st.integers(0, 30 * MS),
        "jitter": st.integers(0, 12 * MS),
        "gap": st.tuples(st.integers(0, 900), st.integers(0, 400)),  # start and length, ms
        "restart": st.integers(0, 2_000),  # ms; above 1000 the stream does not restart
        "every_twice": st.integers(3, 50),
        "every_lost": st.integers(3, 50),
    }
)


def sent(name: str, given_by: dict[str, Any], dice: Random) -> list[tuple[int, str, int, int]]:
    """Return arrival (ns), stream, stamp (ns) and epoch of a device's samples in one second."""
    found = []
    begin, length = given_by["gap"]
    for k in range(1_000 * MS // given_by["period"]):
        t = T0 + given_by["phase"] + k * given_by["period"]
        since = (t - T0) // MS
        if begin <= since < begin + length or k % given_by["every_lost"] == 1:
            continue
        epoch = int(since >= given_by["restart"])
        arrival = t + given_by["delay"] + dice.randrange(given_by["jitter"] + 1)
        times = 2 if k % given_by["every_twice"] == 0 else 1
        found += [(arrival, name, t, epoch)] * times
    return found


@given(
    st.lists(streams, min_size=1, max_size=4),
    st.sampled_from(["smooth", "fast"]),
    st.sampled_from([4 * MS, 10 * MS, 25 * MS]),
    st.integers(0, 2**32),
)
def test_every_sample_has_one_outcome_and_frames_are_correct_for_any_device(
    given_by: list[dict[str, Any]], mode: str, period: int, seed: int
) -> None:
    named, dice = dict(zip("ABCD", given_by, strict=False)), Random(seed)
    a = aligner(period, mode, **{name: one["period"] for name, one in named.items()})
    pushes = sorted(push for name, one in named.items() for push in sent(name, one, dice))
    frames: list[AlignedFrame] = []
    early = Counter[str]()
    for arrival, name, t, epoch in pushes:
        while (deadline := a.next_deadline_ns) is not None and deadline < arrival:
            frames += a.advance(deadline)
        verdict = a.push(name, t, arrival, turned(t), epoch=epoch)
        early[name] += verdict is not None
        frames += a.advance(arrival)
        assert a.counts(name)["pending"] <= 512
    a.close()
    came = Counter(name for _, name, _, _ in pushes)
    for name in named:
        counts = assert_accounted(a, name)
        assert counts["received"] == came[name]
        assert counts["pending"] == 0
        assert early[name] <= counts["late"] + counts["duplicate"] + counts["dropped"]
    assert all(one.t_ns < other.t_ns for one, other in pairwise(frames))
    assert all(one.completed_ns <= other.completed_ns for one, other in pairwise(frames))
    for frame in frames:  # motion at a constant rate is also extrapolated exactly
        for q in frame.orientations.values():
            assert q == pytest.approx(turned(frame.t_ns), abs=1e-9)
