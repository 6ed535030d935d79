"""The event log round-trips, even with an incomplete end."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import orjson
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.calibration import FitResult
from jointfit_daemon.config import parse_rig
from jointfit_daemon.model import (
    Chain,
    Chunk,
    FusionMode,
    JointAngles,
    JointState,
    LimbState,
    SegmentState,
    SyncState,
)
from jointfit_daemon.outputs.recording import (
    EventLogWriter,
    _event_log,
    encode_state,
    read_events,
    read_states,
)
from jointfit_daemon.outputs.recording._event_log import decode_event, encode_event
from jointfit_daemon.pipeline.events import (
    CalibrationStored,
    ChunkArrived,
    Configured,
    JobFinished,
    JobProgress,
    Request,
    SourceClosed,
    SourceOpened,
    Tick,
    UnixOffset,
)
from tests.limb_model.plain_calibration import plain_calibration

if TYPE_CHECKING:
    from jointfit_daemon.pipeline.events import Event

instants = st.integers(0, 2**62)
words = st.text(max_size=20)
json_values = st.recursive(
    st.none() | st.booleans() | st.floats(allow_nan=False, allow_infinity=False) | words,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=3),
    max_leaves=5,
)
tables = st.dictionaries(words, json_values, max_size=3)
reasons = st.none() | words
chain = Chain(("hip", "knee"), ("thigh",), (("S1",),))
results = st.builds(FitResult, refused=words) | st.builds(
    FitResult,
    tables,
    st.none() | tables,
    st.none() | st.just(plain_calibration(chain)),
    reasons,
    reasons,
    st.none() | st.lists(words, max_size=3).map(tuple),
)
events = st.one_of(
    st.builds(ChunkArrived, words, st.builds(Chunk, instants, st.binary(max_size=100))),
    st.builds(Tick, instants),
    st.builds(SourceOpened, instants, words),
    st.builds(SourceClosed, instants, words, st.sampled_from(["lost", "removed"]), words),
    st.builds(Request, instants, words, words, tables),
    st.builds(JobFinished, instants, st.integers(0, 99), st.none() | results, st.none() | words),
    st.builds(JobProgress, instants, st.integers(0, 99), st.floats(0.0, 1.0), words),
    st.builds(CalibrationStored, instants, st.integers(1, 99)),
    st.builds(UnixOffset, instants, st.integers(-(2**62), 2**62)),
)
angles = st.floats(allow_nan=False, allow_infinity=False)
states = st.builds(
    LimbState,
    st.integers(0, 2**53),
    instants,
    instants,
    st.just("imu"),
    st.just("locked"),
    st.just(("flag",)),
    st.tuples(st.builds(SegmentState, words, st.tuples(*[angles] * 4), angles, st.tuples(words))),
    st.tuples(
        st.builds(JointState, words, st.none(), st.none(), st.builds(JointAngles, *[angles] * 3))
    ),
)


@given(events)
def test_every_event_round_trips(event: Event) -> None:
    assert decode_event(orjson.loads(encode_event(event))) == event


def test_configuration_round_trips_with_its_rig(table: dict[str, Any]) -> None:
    event = Configured(5, parse_rig(table), None, None, 7.5)
    assert decode_event(orjson.loads(encode_event(event))) == event


@given(states, states)
def test_states_are_equal_exactly_when_their_bytes_are(one: LimbState, other: LimbState) -> None:
    assert (encode_state(one) == encode_state(other)) == (repr(one) == repr(other))


async def test_log_returns_events_and_states_in_order(tmp_path: Path) -> None:
    log = EventLogWriter(tmp_path / "logs", "rig")
    writing = asyncio.create_task(log.run(), name="log")
    state = LimbState(1, 2, 3, FusionMode.IMU, SyncState.LOCKED, (), (), ())
    given_events = [Tick(n) for n in range(1000)]
    for event in given_events:
        log.event(event)
        log.output(state)
    await asyncio.sleep(2 * _event_log.FLUSH_S)
    assert log.health().backlog_bytes == 0
    log.event(Tick(1000))
    writing.cancel()
    await asyncio.wait([writing])
    assert list(read_events(log.path)) == [*given_events, Tick(1000)]
    assert list(read_states(log.path)) == [encode_state(state)] * 1000


async def test_incomplete_last_line_is_skipped(tmp_path: Path) -> None:
    log = EventLogWriter(tmp_path, "rig")
    log.event(Tick(1))
    log.event(Tick(2))
    log.close()
    os.truncate(log.path, log.path.stat().st_size - 3)
    assert list(read_events(log.path)) == [Tick(1)]


@pytest.mark.parametrize("content", [b"", b"hello\n", b'{"log":99}\n', b"[]\n"])
def test_other_file_is_reported_as_no_event_log(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.jsonl"
    path.write_bytes(content)
    with pytest.raises(ValueError, match="event log"):
        list(read_events(path))


async def test_a_full_disk_ends_the_log_and_not_the_daemon(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    log = EventLogWriter(tmp_path, "rig")
    log._file.close()
    log._file = await asyncio.to_thread(Path("/dev/full").open, "wb", 0)
    log.event(Tick(1))
    await asyncio.wait_for(log.run(), 5)
    assert "No space left" in str(log.health().failure)
    log.event(Tick(2))
    assert log.health().backlog_bytes == 0
    assert "ended early" in caplog.text


async def test_slow_disk_ends_the_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jointfit_daemon.outputs.recording._event_log.PENDING_BYTES", 1000)
    log = EventLogWriter(tmp_path, "rig")
    for n in range(200):
        log.event(Tick(n))
    assert "too slow" in str(log.health().failure)
    log.close()
