"""The WitMotion codec decodes documented frames and counts every byte, however data are split."""

from __future__ import annotations

import itertools
import json
import struct
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.orientation import OrientationGate, canonical
from jointfit_protocols.witmotion import (
    BAUD_CODES,
    FRAME_BYTES,
    FULL_SCALE,
    RATE_CODES,
    SAVE,
    UNLOCK,
    WitMotionCodec,
    WitMotionFrame,
    WitMotionFrameKind,
    WitMotionRegister,
    acceleration_of,
    content_bits,
    counts_of,
    decode_command,
    encode,
    encode_counts,
    encode_time,
    rate_of,
    read_register,
    registers_of,
    time_of,
    write_register,
)

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data" / "imu"
VECTORS: dict[str, dict[str, Any]] = (
    {
        entry["id"]: entry
        for entry in json.loads((SHARED / "vectors.json").read_text(encoding="utf-8"))
        if entry["protocol"] == "witmotion-0x55"
    }
    if SHARED.is_dir()
    else {}
)
EPOCH = datetime(2000, 1, 1)  # noqa: DTZ001 - the device has no time zone

counts = st.integers(-(2**15), 2**15 - 1)
frames = st.builds(encode, st.integers(0x50, 0x5F), st.binary(min_size=8, max_size=8))
false_heads = st.sampled_from([b"U", b"UY", b"UUU", b"Ua", b"\x55\x59\x00\x40"])
wires = st.lists(frames | st.binary(max_size=30) | false_heads, max_size=10).map(b"".join)


def decode(pieces: list[bytes]) -> tuple[list[WitMotionFrame | CorruptBytes], WitMotionCodec]:
    codec = WitMotionCodec()
    found = [event for piece in pieces for event in codec.feed(piece)]
    return found + codec.flush(), codec


@given(wires, st.lists(st.integers(0, 300), max_size=6))
def test_frames_do_not_depend_on_the_cut_and_every_byte_is_counted(
    wire: bytes, cuts: list[int]
) -> None:
    whole, codec = decode([wire])
    at = sorted({0, len(wire), *(place % (len(wire) + 1) for place in cuts)})
    assert decode([wire[a:b] for a, b in itertools.pairwise(at)])[0] == whole
    assert decode([bytes([byte]) for byte in wire])[0] == whole
    used = sum(
        FRAME_BYTES if isinstance(item, WitMotionFrame) else item.discarded for item in whole
    )
    assert used == len(wire) == codec.messages * FRAME_BYTES + codec.discarded


@given(st.lists(frames, min_size=1, max_size=5), st.integers(1, 10))
def test_a_frame_after_a_cut_off_one_is_found(sent: list[bytes], missing: int) -> None:
    wire = sent[0][missing:] + b"".join(sent)
    found, _ = decode([wire])
    assert found[-1] == WitMotionFrame(sent[-1][1], sent[-1][2:10], len(wire))


def test_a_valid_frame_inside_a_corrupt_candidate_is_found() -> None:
    true = encode(0x59, encode_counts((1, 2, 3, 4)))
    found, codec = decode([b"\x55\x59\x01" + true])
    assert found == [CorruptBytes(3, "checksum"), WitMotionFrame(0x59, true[2:10], 14)]
    assert codec.checksum_failures == 1


def test_long_noise_is_reported_in_bounded_runs() -> None:
    found, codec = decode([bytes(5000)])
    assert [item.discarded for item in found if isinstance(item, CorruptBytes)] == [1024] * 4 + [
        904
    ]
    assert codec.pending == 0


@pytest.mark.parametrize("size", [20, 28])
def test_the_variant_55_61_is_recognized_and_not_decoded(size: int) -> None:
    frame = struct.pack("<BB", 0x55, 0x61) + bytes(range(1, size - 1))
    found, codec = decode([frame * 10])
    assert codec.other_frames >= 8
    assert not any(isinstance(item, WitMotionFrame) for item in found)


@pytest.mark.parametrize("before", range(30))
def test_the_first_start_55_61_is_not_counted_wherever_it_is(before: int) -> None:
    """A single sequence 55 61 can be noise."""
    _, codec = decode([bytes(before) + b"\x55\x61" + bytes(18)])
    assert codec.other_frames == 0


def test_encode_refuses_what_the_format_does_not_allow() -> None:
    with pytest.raises(ValueError, match="0x61"):
        encode(0x61, bytes(8))
    with pytest.raises(ValueError, match="7 bytes"):
        encode(0x59, bytes(7))


@given(counts, counts, counts, counts)
def test_counts_survive_both_directions(w: int, x: int, y: int, z: int) -> None:
    assert counts_of(encode_counts((w, x, y, z))) == (w, x, y, z)


@given(st.integers(0, 36_525 * 86_400_000 - 1))
def test_calendar_time_agrees_with_the_calendar_of_python(ticks: int) -> None:
    data = encode_time(ticks)
    date = EPOCH + timedelta(milliseconds=ticks)
    wanted = (date.year - 2000, date.month, date.day, date.hour, date.minute, date.second)
    assert tuple(data[:6]) == wanted
    assert time_of(data) == ticks


def test_a_clock_that_was_never_set_is_accepted_and_impossible_times_are_not() -> None:
    assert time_of(bytes(8)) == 0
    for data in ("1a0d04050607", "1a0320050607", "1a0304180607", "1a0304053c07", "1a030405063c"):
        assert time_of(bytes.fromhex(data) + bytes(2)) is None
    assert time_of(bytes.fromhex("1a0304050607e803")) is None


def test_the_limits_of_the_calendar_are_accepted() -> None:
    last = bytes((99, 12, 31, 23, 59, 59)) + (999).to_bytes(2, "little")
    assert time_of(last) == 36_525 * 86_400_000 - 1
    assert encode_time(36_525 * 86_400_000 - 1) == last
    assert time_of(bytes((0, 2, 29, 0, 0, 0, 0, 0))) == 59 * 86_400_000
    assert time_of(bytes((0, 3, 1, 0, 0, 0, 0, 0))) == 60 * 86_400_000
    assert time_of(bytes((1, 3, 1, 0, 0, 0, 0, 0))) == (366 + 59) * 86_400_000


@pytest.mark.parametrize("year", [0, 1, 3, 4])
def test_every_month_begins_on_the_day_of_the_calendar(year: int) -> None:
    for month in range(1, 13):
        first = datetime(2000 + year, month, 1)  # noqa: DTZ001 - the device has no time zone
        ticks = (first - EPOCH).days * 86_400_000
        assert time_of(bytes((year, month, 1, 0, 0, 0, 0, 0))) == ticks
        assert encode_time(ticks) == bytes((year, month, 1, 0, 0, 0, 0, 0))


def test_counts_beyond_16_bits_are_clipped() -> None:
    assert counts_of(encode_counts((40_000, -40_000, 32_767, -32_768))) == (
        32_767, -32_768, 32_767, -32_768,
    )  # fmt: skip


def test_numbers_are_those_of_the_protocol_pages() -> None:
    assert [kind.value for kind in WitMotionFrameKind] == [*range(0x50, 0x5B), 0x5F]
    assert [register.value for register in WitMotionRegister] == [
        0x00, 0x02, 0x03, 0x04, 0x23, 0x24, 0x27, 0x2E, 0x69,
    ]  # fmt: skip
    assert RATE_CODES == {10: 6, 20: 7, 50: 8, 100: 9, 200: 11}
    speeds = (4800, 9600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 921_600)
    assert {speed: code for code, speed in enumerate(speeds, 1)} == BAUD_CODES
    assert (UNLOCK.hex(), SAVE.hex()) == ("ffaa6988b5", "ffaa000000")
    assert content_bits(0x50, 0x51, 0x59, 0x59) == 0x203
    assert decode_command(UNLOCK + b"\0") is None


def test_counts_have_the_units_of_the_protocol_pages() -> None:
    data = encode_counts((32_767, -16_384, 1, 0))
    assert acceleration_of(data) == pytest.approx([156.8 * 32_767 / 32_768, -78.4, 156.8 / 32_768])
    turn = 34.906585039886591  # 2000 degrees/s
    assert rate_of(data) == pytest.approx([turn * 32_767 / 32_768, -turn / 2, turn / 32_768])
    assert registers_of(b"\1\0\2\0\3\0\xff\xff") == (1, 2, 3, 65_535)


@pytest.mark.parametrize("kind", [0x4F, 0x50, 0x5F, 0x60])
def test_kinds_are_0x50_to_0x5f(kind: int) -> None:
    body = bytes((0x55, kind)) + bytes(8)
    found, codec = decode([body + bytes((sum(body) & 0xFF,))])
    assert codec.messages == (kind in range(0x50, 0x60))
    assert isinstance(found[0], WitMotionFrame) == (kind in range(0x50, 0x60))


@pytest.mark.skipif(not VECTORS, reason="vectors.json is not here")
@pytest.mark.parametrize("name", sorted(VECTORS))
def test_vectors(name: str) -> None:
    vector = VECTORS[name]
    wire = bytes.fromhex(vector["hex"])
    if name.startswith("wit-cmd"):
        commands = {
            "wit-cmd-unlock": UNLOCK,
            "wit-cmd-rsw-time-quat": write_register(
                WitMotionRegister.CONTENT,
                content_bits(WitMotionFrameKind.TIME, WitMotionFrameKind.QUATERNION),
            ),
            "wit-cmd-rate-100": write_register(WitMotionRegister.RATE, 0x09),
            "wit-cmd-baud-115200": write_register(WitMotionRegister.BAUD, 0x06),
            "wit-cmd-save": SAVE,
        }
        assert commands[name] == wire
        command = decode_command(wire)
        assert command is not None
        assert write_register(*command) == wire
        return
    (found,), codec = decode([wire])
    if not vector["valid"]:
        assert isinstance(found, CorruptBytes)
        assert codec.checksum_failures == 1
        return
    assert isinstance(found, WitMotionFrame)
    assert encode(found.kind, found.data) == wire
    expected = vector["decoded"]
    if "time" in expected:
        ticks = time_of(found.data)
        assert ticks is not None
        assert EPOCH + timedelta(milliseconds=ticks) == datetime.fromisoformat(expected["time"])
    elif expected["native_wxyz"] is not None:
        assert list(counts_of(found.data)) == expected["raw"]
        native = tuple(count / FULL_SCALE for count in counts_of(found.data))
        assert native == pytest.approx(expected["native_wxyz"])
        q = OrientationGate().admit(canonical(native, "ENU"))  # type: ignore[arg-type]
        assert q == pytest.approx(expected["canonical_wxyz"], abs=1e-8)
    else:
        assert found.kind != WitMotionFrameKind.QUATERNION


def test_a_read_command_is_a_write_to_the_register_read() -> None:
    assert read_register(WitMotionRegister.CONTENT).hex() == "ffaa270200"
    assert decode_command(b"\xff\xab\x02\x00\x00") is None


@given(counts, counts, counts, counts)
def test_the_witmotion_package_reads_the_same_values(w: int, x: int, y: int, z: int) -> None:
    """The package agrees on quaternion, acceleration and rate. Times are not compared, because the
    package uses another epoch than the vendor's page.
    """
    oracle = pytest.importorskip("witmotion.protocol")
    data = encode_counts((w, x, y, z))
    assert oracle.QuaternionMessage.compute_checksum(data) == encode(0x59, data)[-1]
    assert tuple(oracle.QuaternionMessage.parse(data).q) == (
        w / 32768, x / 32768, y / 32768, z / 32768,
    )  # fmt: skip
    assert acceleration_of(data) == pytest.approx(oracle.AccelerationMessage.parse(data).a)
    theirs = [
        value * 3.141592653589793 / 180 for value in oracle.AngularVelocityMessage.parse(data).w
    ]
    assert rate_of(data) == pytest.approx(theirs)
