"""The LPMS codec for CAN agrees with the test vectors and with cantools.

It combines the two frames of a quaternion only if they follow each other in order and in time.
"""

from __future__ import annotations

import itertools
import json
from math import sqrt
from typing import TYPE_CHECKING, Any

import cantools
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols.can import CanFrame
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.lpms import LpBusCodec, LpBusMessage, unit_of
from jointfit_protocols.lpms.channels import (
    HEARTBEAT,
    ChannelIds,
    ChannelQuaternion,
    Heartbeat,
    LpmsCanCodec,
    encode_frames,
    encode_heartbeat,
    sequential_ids,
    tpdo_ids,
)
from jointfit_protocols.orientation import canonical

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_protocols.lpms.channels import Precision

HALF_NS = 5_000_000
NODE = ChannelIds(tpdo_ids(1), HEARTBEAT + 1)
shorts = st.integers(-32768, 32767)


def codec(precision: Precision, ids: ChannelIds = NODE) -> LpmsCanCodec:
    return LpmsCanCodec(ids, precision, (1, 2, 3, 4), HALF_NS)


def vectors(shared_data: Path) -> dict[str, dict[str, Any]]:
    everything = json.loads((shared_data / "imu" / "vectors.json").read_text())
    return {each["id"]: each for each in everything if each["protocol"] == "lpms-can"}


def frame_of(vector: dict[str, Any], t_ns: int = 0) -> CanFrame:
    data = bytes.fromhex(vector["hex"])
    assert len(data) == vector["dlc"]
    return CanFrame(t_ns, vector["can_id"], data)


def test_the_eight_vectors(shared_data: Path) -> None:
    known = vectors(shared_data)
    assert len(known) == 8

    sequential = ChannelIds(sequential_ids(1, spaced=False))
    for key, ids in (
        ("lpcan-tpdo1-i16", NODE),
        ("lpcan-tpdo1-i16-old", NODE),
        ("lpcan-seq-i16", sequential),
    ):
        decoded = known[key]["decoded"]
        found = codec("int16", ids).feed(frame_of(known[key]))
        assert isinstance(found, ChannelQuaternion)
        assert list(found.values) == decoded["raw"]
        unit = unit_of(found.values)
        assert unit == (1_000 if key.endswith("old") else 10_000)
        w, x, y, z = (value / unit for value in found.values)
        assert list(canonical((w, x, y, z), "NWU", world_to_sensor=True)) == pytest.approx(
            decoded["canonical_wxyz"], abs=1e-9
        )

    floats = codec("float32")
    assert floats.feed(frame_of(known["lpcan-f32-wx"], 100)) is None
    found = floats.feed(frame_of(known["lpcan-f32-yz"], 200))
    wanted = known["lpcan-f32-yz"]["decoded"]["native_wxyz"]
    assert found == ChannelQuaternion(100, tuple(wanted))

    beat = known["lpcan-heartbeat"]
    assert floats.feed(frame_of(beat, 7)) == Heartbeat(7, beat["decoded"]["state"])
    assert encode_heartbeat(0x701).data.hex() == beat["hex"]

    pieces = [frame_of(known[f"lpcan-wrap-{k}"]).data for k in (0, 1)]
    (message,) = [item for piece in pieces for item in LpBusCodec().feed(b"".join(pieces))][:1]
    assert isinstance(message, LpBusMessage)
    assert (message.command, message.data.hex()) == (0x0A, "00000400")


@given(st.tuples(shorts, shorts, shorts, shorts))
def test_an_independent_reader_agrees(shared_data: Path, counts: tuple[int, ...]) -> None:
    oracle = cantools.database.load_file(
        shared_data / "imu" / "dbc" / "lpms3_canopen_quat16_node1.dbc"
    )
    assert isinstance(oracle, cantools.database.Database)
    frame = encode_frames(NODE.frames, (*counts, *[0] * 12), "int16")[0]
    theirs = oracle.decode_message(frame.can_id, frame.data)
    assert isinstance(theirs, dict)
    found = codec("int16").feed(frame)
    assert isinstance(found, ChannelQuaternion)
    assert [theirs[f"Quat{part}"] for part in "WXYZ"] == pytest.approx(
        [value / 10_000 for value in found.values], abs=1e-12
    )
    beat = encode_heartbeat(HEARTBEAT + 1, 5)
    assert oracle.decode_message(beat.can_id, beat.data) == {"State": 5}


def test_the_two_rules_of_sequential_identifiers() -> None:
    """The vendor's documents contain two rules for the identifiers of a node."""
    assert sequential_ids(1, spaced=False) == (0x515, 0x516, 0x517, 0x518)
    assert sequential_ids(1, spaced=True) == (0x514, 0x515, 0x516, 0x517)
    assert sequential_ids(2, spaced=True) == (0x51C, 0x51D, 0x51E, 0x51F)
    shared = {*sequential_ids(1, spaced=False)} & {*sequential_ids(2, spaced=False)}
    assert len(shared) == 3  # neighbouring nodes overlap


def halves(number: int, t_ns: int) -> list[CanFrame]:
    q = (sqrt(0.5), float(number), -sqrt(0.5), float(number))
    return encode_frames(NODE.frames, (*q, 0, 0, 0, 0), "float32", t_ns)[:2]


def test_a_repeated_first_half_drops_the_older_one() -> None:
    decoder = codec("float32")
    (first, _), (second, rest) = halves(1, 0), halves(2, 1000)
    assert decoder.feed(first) is None
    assert decoder.feed(second) is None
    found = decoder.feed(rest)
    assert isinstance(found, ChannelQuaternion)
    assert (found.t_ns, found.values[1], found.values[3]) == (1000, 2.0, 2.0)
    assert decoder.incomplete == 1


def test_halves_in_the_wrong_order_give_no_quaternion() -> None:
    decoder = codec("float32")
    frames = [frame for n in range(10) for frame in reversed(halves(n, n * 10_000_000))]
    assert [decoder.feed(frame) for frame in frames] == [None] * 20
    decoder.flush()
    assert decoder.incomplete == 20


def test_stamps_that_decrease_by_a_clock_error_do_not_tear_a_sample() -> None:
    """The two frames of a quaternion are combined even if the second stamp is slightly earlier."""
    decoder = codec("float32")
    (first, _), (_, rest) = halves(1, 1000), halves(1, 900)
    assert decoder.feed(first) is None
    assert isinstance(decoder.feed(rest), ChannelQuaternion)


def test_halves_of_two_periods_are_not_combined() -> None:
    decoder = codec("float32")
    (first, _), (_, late) = halves(1, 0), halves(2, HALF_NS + 1)
    assert decoder.feed(first) is None
    assert decoder.feed(late) is None
    assert decoder.incomplete == 2


@given(st.permutations(range(1, 17)), st.lists(shorts, min_size=16, max_size=16))
def test_any_mapping_finds_its_channels(order: list[int], channels: list[int]) -> None:
    mapping = (order[0], order[1], order[2], order[3])
    decoder = LpmsCanCodec(NODE, "int16", mapping, HALF_NS)
    found = [decoder.feed(frame) for frame in encode_frames(NODE.frames, channels, "int16")]
    (quaternion,) = [item for item in found if isinstance(item, ChannelQuaternion)]
    assert quaternion.values == tuple(channels[channel - 1] for channel in mapping)
    assert decoder.messages == 4
    assert decoder.incomplete == 0


can_frames = st.builds(
    CanFrame,
    st.integers(0, 10**9),
    st.sampled_from([*NODE.frames, HEARTBEAT + 1, 0x21]),
    st.binary(max_size=8) | st.binary(min_size=8, max_size=8),
    extended=st.booleans(),
    error=st.booleans(),
)


@pytest.mark.parametrize("precision", ["int16", "float32"])
@given(st.lists(can_frames))
def test_every_frame_is_accounted_for(precision: Precision, frames: list[CanFrame]) -> None:
    decoder = codec(precision)
    found = [decoder.feed(frame) for frame in frames]
    decoder.flush()
    corrupt = sum(isinstance(item, CorruptBytes) for item in found)
    assert decoder.messages + decoder.foreign + corrupt == len(frames)
    used = sum(isinstance(item, ChannelQuaternion) for item in found)
    beats = sum(isinstance(item, Heartbeat) for item in found)
    each = 1 if precision == "int16" else 2
    assert used * each + decoder.incomplete + decoder.idle + beats == decoder.messages


def test_sensors_interleave_freely() -> None:
    nodes = [ChannelIds(tpdo_ids(node)) for node in (1, 2, 3)]
    streams = [encode_frames(ids.frames, [float(k)] * 8, "float32") for k, ids in enumerate(nodes)]
    mixed = list(itertools.chain(*zip(*streams, strict=True)))
    for k, ids in enumerate(nodes):
        decoder = codec("float32", ids)
        found = [item for item in map(decoder.feed, mixed) if item is not None]
        assert found == [ChannelQuaternion(0, (k, k, k, k))]
        assert (decoder.foreign, decoder.idle) == (8, 2)
