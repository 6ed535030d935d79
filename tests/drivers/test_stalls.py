"""A stall of a sender or receiver counts as a delay or a pause, never as a restart."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from jointfit_drivers.xbus._continuity import XbusContinuity
from jointfit_drivers.xcdi._continuity import XcdiContinuity

if TYPE_CHECKING:
    from collections.abc import Callable

TICK_NS = 100_000
PERIOD_NS = 10_000_000
APART_NS = 20_000  # time between the arrivals of messages that were buffered
BEFORE = 40  # number of messages before the stall


class Received(NamedTuple):
    """A message as it arrives."""

    counter: int
    ticks: int
    arrival_ns: int


def xbus_restarts(stream: list[Received]) -> int:
    follow = XbusContinuity(100.0)
    return sum(
        follow.orientation(one.counter % 65536, one.ticks, one.arrival_ns).restarted
        for one in stream
    )


def xcdi_restarts(stream: list[Received]) -> int:
    follow = XcdiContinuity()
    return sum(
        follow.group(
            one.ticks, one.counter % 65536, broken=False, host_ticks=one.arrival_ns // TICK_NS
        ).restarted
        for one in stream
    )


FAMILIES = pytest.mark.parametrize("restarts", [xbus_restarts, xcdi_restarts])
starts = st.tuples(st.integers(1_000_000, 2**31), st.integers(0, 65535))
"""Device time and counter of the first message."""
stalls_ms = st.integers(500, 10_000)


def sampled(number: int, first_tick: int) -> int:
    return first_tick + number * PERIOD_NS // TICK_NS


def paused_sender(
    start: tuple[int, int], stall_ms: int, buffered: int, lost: int
) -> list[Received]:
    """Return the messages of a sender that pauses, sends its buffer, and then continues.

    The counter counts the messages that were sent, and `lost` further messages.
    """
    skipped = stall_ms * 1_000_000 // PERIOD_NS
    resumed_ns = (BEFORE + skipped) * PERIOD_NS
    stream: list[Received] = []
    for count in range(BEFORE + buffered + 60):
        late = BEFORE <= count < BEFORE + buffered
        number = count if count < BEFORE + buffered else count + skipped - buffered
        arrival = resumed_ns + (count - BEFORE) * APART_NS if late else number * PERIOD_NS
        counter = start[1] + count + (lost if count >= BEFORE + buffered else 0)
        arrival = max(arrival, stream[-1].arrival_ns if stream else 0)
        stream.append(Received(counter, sampled(number, start[0]), arrival))
    return stream


def stalled_receiver(
    start: tuple[int, int], stall_ms: int, kept: int, resets_counter: int = 0
) -> list[Received]:
    """Return the messages at a receiver that pauses; its buffer holds `kept` messages.

    After the pause, the counter is lower by `resets_counter` than without the pause.
    """
    missed = stall_ms * 1_000_000 // PERIOD_NS
    resumed_ns = (BEFORE + missed) * PERIOD_NS
    stream: list[Received] = []
    for number in range(BEFORE + missed + 60):
        if BEFORE + kept <= number < BEFORE + missed:
            continue
        late = BEFORE <= number < BEFORE + missed
        arrival = resumed_ns + (number - BEFORE) * APART_NS if late else number * PERIOD_NS
        arrival = max(arrival, stream[-1].arrival_ns if stream else 0)
        counter = number + start[1]
        if number >= BEFORE + missed:
            counter -= resets_counter
        stream.append(Received(counter, sampled(number, start[0]), arrival))
    return stream


@FAMILIES
@given(starts, stalls_ms, st.integers(0, 25), st.sampled_from([0, 0, 20]))
def test_a_sender_that_pauses_and_empties_its_buffer_did_not_restart(
    restarts: Callable[[list[Received]], int],
    start: tuple[int, int],
    stall_ms: int,
    buffered: int,
    lost: int,
) -> None:
    assert restarts(paused_sender(start, stall_ms, buffered, lost)) == 0


@FAMILIES
@given(starts, stalls_ms, st.integers(12, 25))
def test_a_port_reopened_during_a_stall_shows_no_restart(
    restarts: Callable[[list[Received]], int],
    start: tuple[int, int],
    stall_ms: int,
    buffered: int,
) -> None:
    stream = paused_sender(start, stall_ms, buffered, 0)
    assert restarts(stream[BEFORE:]) == 0  # the reopened port begins with late messages


@FAMILIES
@example(start=(1_000_000, 0), stall_ms=250, kept=10, uncounted=True)
@example(start=(1_000_000, 0), stall_ms=500, kept=32, uncounted=True)
@given(starts, stalls_ms, st.integers(0, 2000), st.booleans())
def test_a_backlog_of_a_stalled_receiver_is_a_delay_and_no_restart(
    restarts: Callable[[list[Received]], int],
    start: tuple[int, int],
    stall_ms: int,
    kept: int,
    uncounted: bool,
) -> None:
    missed = stall_ms * 1_000_000 // PERIOD_NS
    # The counter of some devices does not count the lost messages.
    resets = max(missed - kept, 0) if uncounted else 0
    if resets and missed < 25:
        return
    assert restarts(stalled_receiver(start, stall_ms, kept, resets)) == 0


@FAMILIES
@given(starts, stalls_ms, st.integers(0, 2000), st.integers(0, 20_000))
def test_a_device_that_restarts_during_a_stall_is_found(
    restarts: Callable[[list[Received]], int],
    start: tuple[int, int],
    stall_ms: int,
    kept: int,
    uptime: int,
) -> None:
    stream = stalled_receiver(start, stall_ms, kept)
    fresh = [
        Received(number, uptime + number * 100, stream[-1].arrival_ns + (number + 1) * PERIOD_NS)
        for number in range(30)
    ]
    backlog = stream[:-60]
    assert restarts(stream + fresh) == 1
    assert restarts(backlog + fresh) == 1


@FAMILIES
@given(starts, stalls_ms, st.integers(3_000, 10**6))
def test_a_clock_that_leaps_more_than_a_backlog_explains_is_a_restart(
    restarts: Callable[[list[Received]], int], start: tuple[int, int], stall_ms: int, leap_ms: int
) -> None:
    stream = paused_sender(start, stall_ms, 10, 0)
    end = BEFORE + 10
    leap = (leap_ms + stall_ms) * 10
    leapt = [one._replace(ticks=one.ticks + leap) for one in stream[end:]]
    assert restarts(stream[:end] + leapt) == 1
