"""Damage of a recording loses only the damaged chunk, and any file is read in bounded memory."""

from __future__ import annotations

import struct
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import pytest
import zstandard
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk as ChunkRecord

from jointfit_daemon.model import Chunk
from jointfit_daemon.outputs.recording import (
    Recorder,
    RecordingError,
    RecordingGap,
    open_recording,
    read_events,
    repair_recording,
)
from jointfit_daemon.outputs.recording import _channels as channels
from jointfit_daemon.outputs.recording._blocks import (
    MOST_RECORD_BYTES,
    ChunkBlock,
    DamagedBlock,
    read_blocks,
)
from jointfit_daemon.pipeline.events import ChunkArrived, SourceOpened, Tick
from tests.outputs.recording.recorded_events import write_recording

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.pipeline.events import Event

BATCHES, BATCH = 8, 40


def event_of(number: int) -> Event:
    if number % 4 == 3:
        return Tick(number)
    return ChunkArrived(f"S{number % 4}", Chunk(number, number.to_bytes(4, "big") * 8))


EVENTS = [event_of(number) for number in range(BATCHES * BATCH)]


@cache
def recorded() -> tuple[bytes, tuple[ChunkBlock, ...]]:
    """Return a recording of `BATCHES` chunks, and these chunks."""
    with TemporaryDirectory() as name:
        recorder = Recorder(Path(name), "rig")
        writer = recorder._writer
        assert writer is not None
        for number, event in enumerate(EVENTS, 1):
            recorder.event(event)
            if number % BATCH == 0:
                writer.write(recorder._take())
        recorder.close()
        (path,) = Path(name).iterdir()
        chunks = tuple(one for one in read_blocks(path) if isinstance(one, ChunkBlock))
        return path.read_bytes(), chunks


def content_of(data: bytes) -> tuple[list[Event], list[RecordingGap]]:
    """Return the events and gaps of a file; check that its repaired copy contains the same."""
    with TemporaryDirectory() as name:
        path, clean = Path(name) / "damaged.mcap", Path(name) / "clean.mcap"
        path.write_bytes(data)
        events, gaps = list(read_events(path)), open_recording(path).gaps()

        result = repair_recording(path, clean)
        assert path.read_bytes() == data
        assert list(read_events(clean)) == events
        assert open_recording(clean).gaps() == gaps == list(result.gaps)
        assert not any(isinstance(block, DamagedBlock) for block in read_blocks(clean))
        with clean.open("rb") as file:
            found = list(make_reader(file, validate_crcs=True).iter_messages())
        assert len(found) == result.messages + len(gaps)
        return events, gaps


def without(lost: Sequence[int]) -> list[Event]:
    """Return the events of all chunks except those with these numbers."""
    return [event for number, event in enumerate(EVENTS) if number // BATCH not in lost]


@settings(max_examples=60)
@given(st.integers(0, BATCHES - 1), st.data())
def test_a_flipped_bit_loses_its_chunk_only(number: int, data: st.DataObject) -> None:
    whole, chunks = recorded()
    chunk = chunks[number]
    place = data.draw(st.integers(chunk.start, chunk.end - 1))
    damaged = bytearray(whole)
    damaged[place] ^= 1 << data.draw(st.integers(0, 7))
    events, gaps = content_of(bytes(damaged))
    if events == EVENTS:  # a bit without meaning, such as a time in the header of the chunk
        assert gaps == []
        return
    assert events == without([number])
    assert [(gap.first_sequence, gap.count) for gap in gaps] == [(number * BATCH, BATCH)]


@settings(max_examples=60)
@given(st.integers(0, BATCHES - 2), st.integers(0, 15))
def test_a_wrong_length_of_a_message_index_loses_nothing(number: int, bit: int) -> None:
    whole, chunks = recorded()
    damaged = bytearray(whole)
    index = chunks[number].end
    assert damaged[index] == Opcode.MESSAGE_INDEX
    damaged[index + 1 + bit // 8] ^= 1 << bit % 8
    assert content_of(bytes(damaged)) == (EVENTS, [])


@settings(max_examples=40)
@given(st.data())
def test_a_torn_file_keeps_every_whole_chunk(data: st.DataObject) -> None:
    whole, chunks = recorded()
    size = data.draw(st.integers(chunks[0].end, len(whole)))
    events, gaps = content_of(whole[:size])
    kept = sum(chunk.end <= size for chunk in chunks)
    assert events == EVENTS[: kept * BATCH]
    assert gaps == []


@settings(max_examples=100)
@given(
    st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=12)), max_size=6), st.integers(0)
)
@example([], 0)
def test_no_damage_raises_anything_but_a_recording_error(
    patches: list[tuple[int, bytes]], size: int
) -> None:
    damaged = bytearray(recorded()[0])
    for place, patch in patches:
        start = place % len(damaged)
        damaged[start : start + len(patch)] = patch
    if size:
        del damaged[size % len(damaged) :]
    with TemporaryDirectory() as name:
        path = Path(name) / "damaged.mcap"
        path.write_bytes(damaged)
        found: list[Event] = []
        with suppress(RecordingError):
            found = list(read_events(path))
        places = [EVENTS.index(event) for event in found if event in EVENTS]
        assert places == sorted(places)


def chunk_record(data: bytes, claimed_bytes: int) -> bytes:
    builder: Any = RecordBuilder()
    ChunkRecord("zstd", data, 0, 0, 0, claimed_bytes).write(builder)
    return bytes(builder.end())


HOSTILE = {
    "a compressed bomb": chunk_record(zstandard.compress(bytes(300_000_000)), 300_000_000),
    "a bomb that claims little": chunk_record(zstandard.compress(bytes(300_000_000)), 1000),
    "a length of gigabytes": struct.pack("<BQ", 0x06, 2**62),
    "metadata of gigabytes": struct.pack("<BQI", 0x0C, 40, 2**31) + bytes(36),
    "a window of gigabytes": chunk_record(b"\x28\xb5\x2f\xfd\x04\xff" + bytes(20), 2**40),
}


@pytest.mark.parametrize("record", HOSTILE)
def test_hostile_records_are_skipped_in_bounded_memory(tmp_path: Path, record: str) -> None:
    whole, chunks = recorded()
    end = chunks[2].end
    path = tmp_path / "hostile.mcap"
    path.write_bytes(whole[:end] + HOSTILE[record] + whole[end:])
    assert list(read_events(path)) == EVENTS
    sizes = [len(block.content) for block in read_blocks(path) if isinstance(block, ChunkBlock)]
    assert max(sizes) < MOST_RECORD_BYTES / 100


def test_recordings_are_read_in_several_threads(tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    path.write_bytes(recorded()[0])
    with ThreadPoolExecutor(4) as pool:
        read = list(pool.map(lambda _: list(read_events(path)), range(60)))
    assert all(events == EVENTS for events in read)


def test_a_recording_of_a_later_version_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("jointfit_daemon.outputs.recording._session_writer.FORMAT", 2)
    path = write_recording(tmp_path, [SourceOpened(1, "S1")])
    with pytest.raises(RecordingError, match=r"of format 2, expected at most 1: .* update this"):
        open_recording(path)


def test_unknown_records_of_a_later_mcap_are_skipped(tmp_path: Path) -> None:
    whole, chunks = recorded()
    end = chunks[1].end
    path = tmp_path / "later.mcap"
    path.write_bytes(whole[:end] + struct.pack("<BQ", 0x90, 5) + b"later" + whole[end:])
    assert list(read_events(path)) == EVENTS
    assert channels.GAP == "recording/gap"
