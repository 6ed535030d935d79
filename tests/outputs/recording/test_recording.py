"""Events and outputs round-trip through a recording; other files are refused with a reason."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import jsonschema
import orjson
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

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
    Recorder,
    RecordingError,
    _recorder,
    encode_state,
    open_recording,
    read_events,
)
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
from tests.outputs.recording.recorded_events import after_recording, write_recording

if TYPE_CHECKING:
    from pathlib import Path

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


@settings(max_examples=30)
@given(st.lists(events, max_size=20))
def test_every_event_round_trips_in_order(some: list[Event]) -> None:
    assert after_recording(some) == some


def test_configuration_round_trips_with_its_rig(table: dict[str, Any]) -> None:
    event = Configured(5, parse_rig(table), None, None, 7.5)
    assert after_recording([event]) == [event]


@given(states, states)
def test_states_are_equal_exactly_when_their_bytes_are(one: LimbState, other: LimbState) -> None:
    assert (encode_state(one) == encode_state(other)) == (repr(one) == repr(other))


async def test_recording_returns_events_and_states_in_order(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "recordings", "rig")
    writing = asyncio.create_task(recorder.run(), name="recorder")
    state = LimbState(1, 2, 3, FusionMode.IMU, SyncState.LOCKED, (), (), ())
    given_events = [Tick(n) for n in range(1000)]
    for event in given_events:
        recorder.event(event)
        recorder.output(state)
    while recorder.path is None or recorder._pending or recorder._writing.locked():
        await asyncio.sleep(_recorder.FLUSH_S / 5)
    unfinished = recorder.path
    assert list(read_events(unfinished)) == given_events  # a file in use is readable
    recorder.event(Tick(1000))
    writing.cancel()
    await asyncio.wait([writing])

    path = unfinished.with_suffix("")
    assert [*path.parent.iterdir()] == [path]
    assert list(read_events(path)) == [*given_events, Tick(1000)]
    assert list(open_recording(path).states()) == [encode_state(state)] * 1000


def test_the_librarys_own_reader_opens_a_recording(tmp_path: Path, table: dict[str, Any]) -> None:
    some: list[Event] = [
        Configured(5, parse_rig(table), plain_calibration(chain), 3),
        SourceOpened(6, "S1"),
        ChunkArrived("S1", Chunk(7, b"bytes")),
        Tick(8),
    ]
    path = write_recording(tmp_path, some)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = list(reader.iter_messages())
        attachments = {one.name: one.data for one in reader.iter_attachments()}
        metadata = {one.name: one.metadata for one in reader.iter_metadata()}

    topics = [channel.topic for _, channel, _ in found]
    assert topics == ["event/configured", "event/opened", "source/S1", "event/tick"]
    for schema, channel, message in found:
        assert {"clock", "stamp_means"} <= channel.metadata.keys()
        if schema is not None:
            jsonschema.validate(orjson.loads(message.data), orjson.loads(schema.data))
    assert found[2][2].data == b"bytes"
    offset_ns = int(metadata["jointfit.recording"]["unix_offset_ns"])
    assert [message.log_time - offset_ns for _, _, message in found] == [5, 6, 7, 8]
    assert [message.sequence for _, _, message in found] == [0, 1, 2, 3]
    assert orjson.loads(attachments["rig.json"])["rig"] == table["rig"]
    assert "segments" in attachments["calibration.json"].decode()
    assert open_recording(path).began_with_daemon


OTHER_FILES = {
    b"": "the file is empty",
    b"\x89MCAP": "ends after 5 bytes",
    b"hello, this is text\n": "does not begin like an MCAP file",
    b"\x89MCAP0\r\n" + bytes(40): "header of the MCAP file is damaged",
    b"\x89MCAP0\r\n\x01\xff\xff\xff\xff\xff\xff\xff\xff": "header of the MCAP file is damaged",
    b"\x89MCAP0\r\n\x01\x0c" + bytes(7) + b"\x04\0\0\0ros2" + bytes(4): "not recorded by jointfitd",
}


@pytest.mark.parametrize("content", OTHER_FILES)
def test_other_file_is_refused_with_a_reason(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=OTHER_FILES[content]):
        list(read_events(path))


def test_slow_disk_causes_a_gap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jointfit_daemon.outputs.recording._recorder.PENDING_BYTES", 5000)
    recorder = Recorder(tmp_path, "rig")
    for n in range(200):
        recorder.event(Tick(n))
    assert recorder._writer is not None
    recorder._writer.write(recorder._take())
    recorder.event(Tick(200))
    assert recorder._gap is not None
    health = recorder.health()
    recorder.close()
    (path,) = tmp_path.iterdir()
    (gap,) = open_recording(path).gaps()
    kept = gap.first_sequence
    assert list(read_events(path)) == [*map(Tick, range(kept)), Tick(200)]
    assert (gap.count, gap.reason) == (200 - kept, "the disk is too slow")
    assert health is not None
    assert health.lost == gap.count


def test_messages_lost_at_the_end_are_a_gap(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("jointfit_daemon.outputs.recording._recorder.PENDING_BYTES", 5000)
    path = write_recording(tmp_path, map(Tick, range(200)))
    (gap,) = open_recording(path).gaps()
    assert gap.first_sequence + gap.count == 200
    assert gap.reason == "the disk is too slow"
