"""The NatNet codec decodes a capture of Motive 2.1 to the values that the vendor's client read."""

from __future__ import annotations

import hashlib
import re
from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.natnet import (
    MARKER_OCCLUDED,
    BodyDescription,
    FrameOfData,
    MarkerSetDescription,
    ModelDefinition,
    ServerInfo,
    decode,
    decode_frame,
    encode,
)
from tests.captured_datagrams import read_udp

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

HZ = 3_312_787


@pytest.fixture(scope="module")
def capture(shared_data: Path) -> Path:
    return shared_data / "mocap" / "natnet_v3_mje-nz" / "test_data"


@pytest.mark.parametrize(
    "name",
    ["connect", "discovery", "echorequest", "echoresponse", "requestmodeldef", "modeldef"],
)
def test_a_captured_message_is_written_back_byte_for_byte(capture: Path, name: str) -> None:
    wire = (capture / f"{name}_packet_v3.bin").read_bytes()
    message = decode(wire, (3, 0))
    assert not isinstance(message, CorruptBytes)
    assert encode(message) == wire


def test_captured_server_info_is_decoded(capture: Path) -> None:
    assert decode((capture / "serverinfo_packet_v3.bin").read_bytes(), (3, 0)) == ServerInfo(
        "Motive", (2, 1, 0, 0), (3, 0, 0, 0), 3_312_787, 1511, True, "239.255.42.99"
    )


def test_the_captured_model_names_one_body_of_five_markers(capture: Path) -> None:
    model = decode((capture / "modeldef_packet_v3.bin").read_bytes(), (3, 0))
    assert isinstance(model, ModelDefinition)
    body, own, every = model.descriptions
    assert isinstance(body, BodyDescription)
    assert (body.name, body.id, body.parent, body.offset) == ("RaceQuad", 2, -1, (0, 0, 0))
    assert body.positions[0] == pytest.approx((0.1611590, 0.0350516, -0.0321813), abs=1e-7)
    assert body.labels == (0,) * 5
    assert own == MarkerSetDescription("RaceQuad", tuple(f"Marker{i}" for i in range(1, 6)))
    assert every == MarkerSetDescription("all", tuple(f"RaceQuad_{i}" for i in range(1, 6)))


def test_an_occluded_marker_comes_with_a_plausible_position(capture: Path) -> None:
    frame = decode((capture / "mocapframe_packet_occluded_v3.bin").read_bytes(), (3, 0))
    assert isinstance(frame, FrameOfData)
    assert frame.number == 269007
    assert frame.timestamp == pytest.approx(8966.9)
    stamps = (frame.exposure, frame.received, frame.transmit)
    assert stamps == (8642283567331, 8642283582567, 8642283586925)
    assert [(s.name, len(s.positions)) for s in frame.marker_sets] == [("FakeTree", 5), ("all", 5)]
    assert [(m.id & 0xFFFF, m.params) for m in frame.markers] == [
        (2, 11),
        (3, 10),
        (4, 10),
        (5, 10),
    ]
    hidden = frame.markers[0]
    assert hidden.params & MARKER_OCCLUDED
    assert 0.1 < abs(hidden.x) < 1
    assert frame.bodies[0].params == 1
    assert frame.bodies[0].error == pytest.approx(6.2e-9, rel=0.01)


@pytest.fixture(scope="module")
def frames(capture: Path) -> list[FrameOfData]:
    packets = read_udp((capture / "raw" / "traffic.pcapng").read_bytes())
    wires = [packet.payload for packet in packets if packet.payload[:2] == b"\x07\0"]
    found = [decode_frame(wire, (3, 0)) for wire in wires]
    return [frame for frame in found if isinstance(frame, FrameOfData)]


def test_frames_are_written_back_to_the_hash_of_the_capture(frames: list[FrameOfData]) -> None:
    assert [frame.number for frame in frames] == list(range(162734, 163252))
    written = b"".join(encode(frame) for frame in frames)
    assert len(written) == 174_048
    assert hashlib.sha256(written).hexdigest() == (
        "10d6bbd6c840a9e2e81fc5f96e2f99fb7c53e69b3c36d8055c7119934acb0092"
    )


def test_first_and_last_captured_frame_match_two_other_parsers(
    frames: list[FrameOfData],
) -> None:
    first, last = frames[0], frames[-1]
    body = first.bodies[0]
    assert (body.x, body.y, body.z) == pytest.approx((0.1744466, 1.4471314, -0.7343040), abs=5e-8)
    assert body[4:8] == pytest.approx((-0.0545942, 0.5099482, 0.0437036, -0.8573577), abs=5e-8)
    assert body.error == pytest.approx(0.000515220, abs=5e-10)
    stamps = (first.exposure, first.received, first.transmit)
    assert stamps == (1416497730518, 1416497745808, 1416497748722)
    assert first.timestamp == pytest.approx(1356.1166667, abs=1e-7)
    assert (last.exposure, last.timestamp) == (1416512003288, 1360.425)


def test_every_frame_has_the_same_parts(frames: list[FrameOfData]) -> None:
    for frame in frames:
        assert (frame.params, frame.timecode, frame.subframe, frame.precision) == (0, 0, 0, None)
        assert (len(frame.other_markers), len(frame.bodies), len(frame.markers)) == (5, 1, 6)
        absent = (frame.marker_sets, frame.skeletons, frame.force_plates, frame.devices)
        assert absent == ((), (), (), ())
        assert (frame.bodies[0].id, frame.bodies[0].params) == (2, 1)
        assert [m.id for m in frame.markers] == [2 << 16 | i for i in range(1, 6)] + [50007]
        assert [m.params for m in frame.markers] == [10] * 5 + [18]
        assert frame.timestamp == pytest.approx(frame.number / 120, abs=3e-13 + 3e-13)


def test_the_whole_capture_has_its_known_sums(frames: list[FrameOfData]) -> None:
    assert sum(frame.received - frame.exposure for frame in frames) == 7_891_558
    assert sum(frame.transmit - frame.received for frame in frames) == 1_391_767
    bodies = np.array([frame.bodies[0] for frame in frames])
    mean = bodies[:, 1:4].mean(axis=0)
    assert mean == pytest.approx((0.1744416, 1.4471301, -0.7343158), abs=5e-8)
    assert np.abs(np.linalg.norm(bodies[:, 4:8], axis=1) - 1).max() < 1.4e-7
    exposures = np.diff([frame.exposure for frame in frames]) / HZ * 1e3
    assert exposures.mean() == pytest.approx(8.333438, abs=1e-6)
    assert exposures.std() == pytest.approx(8.96e-3, abs=2e-5)


# --- the vendor's own client ------------------------------------------------------------------

_FIELD = re.compile(r"-?\d+(?:\.\d+)?")
_OF_A_FRAME = re.compile(
    r"frame|Timestamp|Software|System|Timecode|Other M|Rigid Bod|\t-?\d|Skel|Labeled|Force|Device"
)
_THE_END = "Device [Count"


def printed(capture: Path) -> Iterator[list[list[float]]]:
    """Yield the numbers of each line of each frame, without the other messages of the program."""
    text = (capture / "raw" / "SampleClient_output.txt").read_text(encoding="utf-8")
    for block in text.split("FrameID : ")[1:]:
        lines = ("frame " + block).partition(_THE_END)
        whole = "".join(lines[:2]) + lines[2][:3]
        wanted = [line for line in whole.splitlines() if _OF_A_FRAME.match(line)]
        yield [[float(number) for number in _FIELD.findall(line)] for line in wanted]


def as_printed(frame: FrameOfData) -> list[list[float]]:
    """Return the numbers that the vendor's client prints for a frame, line by line."""
    body = frame.bodies[0]
    ms = 1e3 / HZ
    lines: list[list[float]] = [
        [frame.number],
        [frame.timestamp],
        [(frame.transmit - frame.received) * ms],
        [(frame.transmit - frame.exposure) * ms],
        [0, 0, 0, 0],  # hours, minutes, seconds, frames and sub-frames
        [5],
        *([i, *at] for i, at in enumerate(frame.other_markers)),
        [1],
        [body.id, body.error, body.params & 1],
        list(body[1:8]),
        [0],
        [6],
    ]
    for m in frame.markers:
        flags = [m.params >> bit & 1 for bit in range(3)]
        lines.append([m.id >> 16, m.id & 0xFFFF, *flags, m.size, m.x, m.y, m.z])
    return [*lines, [0], [0]]


def test_every_number_the_vendors_client_printed_is_ours(
    capture: Path, frames: list[FrameOfData]
) -> None:
    by_number = {frame.number: frame for frame in frames}
    blocks = list(printed(capture))
    assert [int(block[0][0]) for block in blocks] == list(range(162734, 162985))
    for block in blocks:
        ours = as_printed(by_number[int(block[0][0])])
        assert len(block) == len(ours) or block is blocks[-1]  # the last block is incomplete
        for wanted, line in zip(ours, block, strict=False):
            assert line == pytest.approx(wanted, abs=0.005 + 1e-6)
