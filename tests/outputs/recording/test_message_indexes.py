"""Programs that seek by time find exactly the messages of an interval in a recording."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING

import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.records import Chunk as ChunkRecord
from mcap.records import Message, MessageIndex

from jointfit_daemon.model import Chunk
from jointfit_daemon.outputs.recording import open_recording
from jointfit_daemon.pipeline.events import ChunkArrived
from tests.outputs.recording.recorded_events import write_recording

if TYPE_CHECKING:
    from pathlib import Path

LAST_NS = 2000
SENSORS = 3
PREFIX_BYTES = 9
"""Number of bytes of the opcode and the length of a record."""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording with several chunks: one message per nanosecond, sensors in turn."""
    events = [ChunkArrived(f"S{t_ns % SENSORS}", Chunk(t_ns, bytes(20))) for t_ns in range(LAST_NS)]
    return write_recording(tmp_path_factory.mktemp("recordings"), events)


def read_by_indexes(path: Path, topic: str, start_ns: int, end_ns: int) -> list[Message]:
    """Return messages by their positions in the message indexes, like Foxglove and PlotJuggler."""
    found = []
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        (number,) = [one.id for one in summary.channels.values() if one.topic == topic]
        for index in summary.chunk_indexes:
            file.seek(index.chunk_start_offset + PREFIX_BYTES)
            content = zstandard.decompress(ChunkRecord.read(ReadDataStream(file)).data)
            file.seek(index.message_index_offsets[number] + PREFIX_BYTES)
            for t_ns, place in MessageIndex.read(ReadDataStream(file)).records:
                if start_ns <= t_ns < end_ns:
                    stream = ReadDataStream(BytesIO(content[place + 1 :]))
                    found.append(Message.read(stream, stream.read8()))
    return found


@given(st.integers(0, LAST_NS), st.integers(0, LAST_NS), st.integers(0, SENSORS - 1))
def test_an_interval_has_exactly_its_messages(
    recording: Path, one: int, other: int, sensor: int
) -> None:
    begin, end = sorted((one, other))
    offset_ns = open_recording(recording).info.unix_offset_ns
    topic, start_ns, end_ns = f"source/S{sensor}", begin + offset_ns, end + offset_ns
    with recording.open("rb") as file:
        found = [
            one
            for *_, one in make_reader(file).iter_messages(
                [topic], starting_at=start_ns, ending_before=end_ns
            )
        ]

    expected = [t_ns for t_ns in range(begin, end) if t_ns % SENSORS == sensor]
    assert [message.log_time - offset_ns for message in found] == expected
    assert read_by_indexes(recording, topic, start_ns, end_ns) == found
