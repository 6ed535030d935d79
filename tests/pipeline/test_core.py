"""The core with byte streams: counts of samples, order of frames, replay."""

from __future__ import annotations

import itertools
import random
from functools import cache
from typing import TYPE_CHECKING

from hypothesis import given, settings
from hypothesis import strategies as st

from jointfit_daemon.model import Chunk
from jointfit_daemon.outputs.recording import encode_state
from jointfit_daemon.pipeline.events import ChunkArrived, SourceClosed, SourceOpened, Tick
from jointfit_protocols.can import RECORD_BYTES
from tests.outputs.recording.recorded_events import after_recording
from tests.pipeline.core_feed import (
    MS,
    PERIOD_NS,
    SENSORS,
    XCDI,
    Bench,
    arrival_ns,
    chunk,
    opening,
    replay_states,
)

if TYPE_CHECKING:
    from jointfit_daemon.pipeline.events import Event

VERDICTS = ("used", "decimated", "idle", "late", "duplicate", "dropped")
COUNT = 40
SOURCES = (*SENSORS, "mocap")
PATIENCE = 1.5
HOST_STAMP_BYTES = 8
"""Size of the host's stamp at the start of a record. Faults of the wire cannot change it."""
SETTLED = 60
"""Samples after which the simulated clocks and delays have settled."""


FATES = ("well", "well", "well", "lost", "late", "spoiled", "torn", "two")


def troubled(dice: random.Random) -> list[Event]:
    """Return the events of all sources, with lost, late, damaged, truncated and repeated samples
    and a reconnect.
    """
    events: list[Event] = []
    for name in SOURCES:
        for number in range(COUNT):
            events += _fated(chunk(name, number), dice.choice(FATES), dice)
    name = dice.choice(SOURCES)
    lost_ns = arrival_ns(chunk(name, dice.randrange(1, COUNT)))
    events += [SourceClosed(lost_ns, name, "lost", "unplugged"), SourceOpened(lost_ns, name)]
    return opening() + sorted(events, key=arrival_ns)


def _fated(sample: ChunkArrived, fate: str, dice: random.Random) -> list[ChunkArrived]:
    t_ns, data = sample.chunk.t_ns, bytearray(sample.chunk.data)
    if fate == "late":
        t_ns += dice.randrange(200 * MS)
    elif fate == "spoiled":
        at = dice.randrange(len(data))
        if sample.source not in XCDI or at % RECORD_BYTES >= HOST_STAMP_BYTES:
            data[at] ^= 1 << dice.randrange(8)
    elif fate == "torn":
        del data[dice.randrange(len(data)) :]
    times = {"lost": 0, "two": 2}.get(fate, 1)
    return [ChunkArrived(sample.source, Chunk(t_ns, bytes(data)))] * times


def fed(events: list[Event]) -> Bench:
    bench = Bench()
    bench.feed(events)
    bench.wait_until(arrival_ns(events[-1]) + 1000 * MS)
    return bench


@settings(max_examples=25)
@given(st.integers(0, 2**32))
def test_every_sample_is_counted_once_and_frames_are_in_order(seed: int) -> None:
    bench = fed(troubled(random.Random(seed)))
    for name, device in bench.devices().items():
        accounted = sum(device[key] for key in (*VERDICTS, "pending"))
        assert device["received"] == accounted, (name, device)
    assert bench.states
    assert all(a.t_ns < b.t_ns for a, b in itertools.pairwise(bench.states))
    assert [state.seq for state in bench.states] == list(range(1, len(bench.states) + 1))


@settings(max_examples=10)
@given(st.integers(0, 2**32))
def test_replay_through_the_log_gives_the_same_states(seed: int) -> None:
    bench = fed(troubled(random.Random(seed)))
    logged = after_recording(bench.fed)
    again = [encode_state(state) for state in replay_states(logged)]
    assert again == [encode_state(state) for state in bench.states]


def test_no_sample_is_pending_after_all_sources_closed() -> None:
    events = opening()
    events += sorted((chunk(s, n) for s in SOURCES for n in range(COUNT)), key=arrival_ns)
    gone_ns = arrival_ns(events[-1]) + 300 * MS
    bench = fed([*events, *(SourceClosed(gone_ns, s, "lost", "unplugged") for s in SOURCES)])
    for name, device in bench.devices().items():
        assert device["received"] == COUNT, name
        assert device["pending"] == 0, (name, device)
        assert sum(device[key] for key in VERDICTS) == COUNT, (name, device)


# --- a missing sample ---------------------------------------------------------------------------


@cache
def waited(missing: frozenset[tuple[str, int]], count: int = SETTLED + 30) -> dict[int, int]:
    """Return the output time of each frame by frame time, ns, without the samples in `missing`."""
    bench = Bench()
    samples = [chunk(s, n) for s in SENSORS for n in range(count) if (s, n) not in missing]
    bench.feed(opening(mocap=False))
    bench.feed(sorted(samples, key=arrival_ns))
    return bench.said_ns


@settings(max_examples=25)
@given(
    st.frozensets(
        st.tuples(st.sampled_from(SENSORS), st.integers(SETTLED, SETTLED + 20)),
        min_size=1, max_size=6,
    )
)  # fmt: skip
def test_missing_samples_delay_a_frame_by_one_and_a_half_periods_at_most(
    missing: frozenset[tuple[str, int]],
) -> None:
    whole, holed = waited(frozenset()), waited(missing)
    last_ns = max(holed) - 5 * PERIOD_NS
    compared = [t_ns for t_ns in whole if t_ns <= last_ns]
    assert len(compared) > SETTLED
    for t_ns in compared:
        assert holed[t_ns] - whole[t_ns] <= PATIENCE * PERIOD_NS, (t_ns, missing)


def test_missing_sample_delays_its_frame() -> None:
    """One missing sample delays a frame by over half a period; the test above limits this delay."""
    whole, holed = waited(frozenset()), waited(frozenset({("S4", SETTLED + 5)}))
    delays = [holed[t_ns] - whole[t_ns] for t_ns in whole if t_ns in holed]
    assert max(delays) > 0.5 * PERIOD_NS


def test_samples_buffered_during_a_stall_are_not_late() -> None:
    bench = Bench()
    bench.feed(opening())
    bench.feed(sorted((chunk(n, i) for n in SOURCES for i in range(2 * SETTLED)), key=arrival_ns))
    late = {name: counts["late"] for name, counts in bench.devices().items()}
    frames = len(bench.states)

    # A process that was stalled for 60 ms reads its sources one after the other, then the timer.
    stalled = range(2 * SETTLED, 2 * SETTLED + 6)
    now_ns = arrival_ns(chunk("mocap", stalled[-1])) + 10 * MS
    for name in SOURCES:
        for number in stalled:
            event = chunk(name, number)
            bench.give(ChunkArrived(name, Chunk(now_ns, event.chunk.data)), now_ns)
    bench.give(Tick(now_ns), now_ns)
    after = range(stalled[-1] + 2, stalled[-1] + 20)
    bench.feed(sorted((chunk(n, i) for n in SOURCES for i in after), key=arrival_ns))

    assert {name: counts["late"] for name, counts in bench.devices().items()} == late
    assert len(bench.states) - frames >= len(stalled) - 1
