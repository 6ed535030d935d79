"""The MIP codec counts every byte of any stream, however the stream is split into chunks."""

from __future__ import annotations

import itertools
import json
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.mip import MAX_PACKET, MipCodec, MipPacket, commands, encode
from jointfit_protocols.mip.data import decode_field, encode_field
from jointfit_protocols.orientation import canonical

if TYPE_CHECKING:
    from collections.abc import Callable

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data" / "imu"
VECTORS: list[dict[str, Any]] = (
    [
        entry
        for entry in json.loads((SHARED / "vectors.json").read_text(encoding="utf-8"))
        if entry["protocol"] == "microstrain-mip"
    ]
    if SHARED.is_dir()
    else []
)

fields = st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=40)), max_size=5)
packets = st.builds(encode, st.integers(0, 255), fields)
false_heads = st.sampled_from([b"u", b"ue", b"ue\x80\xff", b"ueue", b"ue\x80\x02\x01\x01"])
wires = st.lists(packets | st.binary(max_size=30) | false_heads, max_size=8).map(b"".join)


def decode(chunks: list[bytes]) -> tuple[list[MipPacket | CorruptBytes], MipCodec]:
    codec = MipCodec()
    found = [event for chunk in chunks for event in codec.feed(chunk)]
    return found + codec.flush(), codec


def packets_in(wire: bytes) -> list[MipPacket]:
    return [event for event in decode([wire])[0] if isinstance(event, MipPacket)]


@given(wires, st.lists(st.integers(0, 5000), max_size=10))
def test_chunk_boundaries_do_not_change_the_packets(wire: bytes, cuts: list[int]) -> None:
    whole, _ = decode([wire])
    at = sorted({0, len(wire), *(place % (len(wire) + 1) for place in cuts)})
    assert decode([wire[a:b] for a, b in itertools.pairwise(at)])[0] == whole
    assert decode([bytes([byte]) for byte in wire])[0] == whole


@given(wires)
def test_every_byte_is_in_a_packet_or_counted(wire: bytes) -> None:
    found, codec = decode([wire])
    used = sum(event.size for event in found if isinstance(event, MipPacket))
    lost = sum(event.discarded for event in found if isinstance(event, CorruptBytes))
    assert used + lost == len(wire)
    assert lost == codec.discarded
    assert codec.messages == sum(isinstance(event, MipPacket) for event in found)


@given(st.lists(st.binary(max_size=1000), max_size=5))
def test_pending_bytes_are_bounded(chunks: list[bytes]) -> None:
    codec = MipCodec()
    for chunk in chunks:
        codec.feed(b"ue" + chunk)
        assert codec.pending < MAX_PACKET


@given(st.integers(0, 255), fields)
def test_encoded_packet_decodes_to_itself(number: int, content: list[tuple[int, bytes]]) -> None:
    wire = encode(number, content)
    assert decode([wire])[0] == [MipPacket(number, tuple(content), len(wire), len(wire))]


@given(packets, st.integers(0, 10_000), st.integers(0, 7))
def test_a_single_flipped_bit_never_passes(wire: bytes, place: int, bit: int) -> None:
    bad = bytearray(wire)
    bad[place % len(wire)] ^= 1 << bit
    assert all(packet.size < len(wire) for packet in packets_in(bytes(bad)))


@pytest.mark.parametrize(
    ("wire", "reason"),
    [
        (b"abc", "no packet starts here"),
        (b"abcue\x80\x00\x00\x00", "checksum"),
        (b"ue\x80\x20abc", "cut off"),
        (encode(0x80, ())[:3] + b"\x02\x01\x01" + b"\x5e\xc0", "fields do not fill the packet"),
    ],
)
def test_a_run_has_the_reason_of_its_first_real_fault(wire: bytes, reason: str) -> None:
    """A run of corrupt bytes is reported once. Bytes that begin no packet are no real fault."""
    assert decode([wire])[0] == [CorruptBytes(len(wire), reason)]


def test_a_packet_inside_a_broken_one_is_found() -> None:
    inside = encode(0x82, ((3, b"inside"),))
    found = packets_in(b"ue\x80\x60" + inside + bytes(100))
    assert [packet.fields for packet in found] == [((3, b"inside"),)]


def test_more_fields_than_a_packet_holds_are_a_bug_of_the_caller() -> None:
    with pytest.raises(ValueError, match="255"):
        encode(0x80, ((1, bytes(253)), (2, b"")))


# --- vectors ----------------------------------------------------------------------------------


def test_there_are_24_vectors(shared_data: Path) -> None:
    assert len(VECTORS) == 24


@pytest.mark.skipif(not VECTORS, reason="vectors.json is not here")
@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: vector["id"])
def test_vector(vector: dict[str, Any]) -> None:
    wire = bytes.fromhex(vector["hex"])
    found, codec = decode([wire])
    if not vector["valid"]:
        assert (codec.messages, codec.discarded) == (0, len(wire))
        return

    (packet,) = found
    assert isinstance(packet, MipPacket)
    assert encode(packet.descriptor_set, packet.fields) == wire
    expected = vector.get("decoded", {})
    values = {
        descriptor: decode_field(packet.descriptor_set, descriptor, data)
        for descriptor, data in packet.fields
    }
    for descriptor, decoded in values.items():
        if decoded is not None:
            assert encode_field(packet.descriptor_set, descriptor, *decoded) in packet.fields

    times = {0xD5: ("ref_time_ns",), 0xD6: ("delta_ns",), 0x12: ("tow", "week")}
    for descriptor, names in times.items():
        if expected.get(names[0]) is not None:
            found_values = values[descriptor] or ()
            assert found_values[: len(names)] == tuple(expected[name] for name in names)
    if "error" in expected:
        assert commands.reply_code(packet, expected["command"]) == expected["error"]
    if "rate" in expected:
        data = commands.reply_data(packet, commands.Setup.BASE_RATE_REPLY)
        assert commands.decode_rate(b"\x82", data or b"") == expected["rate"]
    check_quaternion(values.get(0x03) or values.get(0x0A), expected)


def check_quaternion(quaternion: tuple[Any, ...] | None, expected: dict[str, Any]) -> None:
    if "valid_flags" in expected:
        assert quaternion is not None
        assert quaternion[4] == expected["valid_flags"]
    if expected.get("native_wxyz"):
        assert quaternion is not None
        native = (quaternion[0], quaternion[1], quaternion[2], quaternion[3])
        assert native == tuple(expected["native_wxyz"])
        assert canonical(native, "NED") == pytest.approx(expected["canonical_wxyz"], abs=1e-8)


REQUESTS: dict[str, Callable[[], bytes]] = {
    "mip-ping": lambda: commands.encode_command(1, commands.Base.PING),
    "mip-idle": lambda: commands.encode_command(1, commands.Base.IDLE),
    "mip-resume": lambda: commands.encode_command(1, commands.Base.RESUME),
    "mip-info": lambda: commands.encode_command(1, commands.Base.DEVICE_INFO),
    "mip-base-rate": lambda: request("current", 0x82, "base_rate"),
    "mip-format-filter": lambda: request("current", 0x82, "format", ((0xD5, 5), (0x03, 5))),
    "mip-format-sensor": lambda: request("current", 0x80, "format", ((0xD5, 10), (0x0A, 10))),
    "mip-format-legacy-imu": lambda: request("legacy", 0x80, "format", ((0x0A, 10), (0x12, 10))),
    "mip-example-format": lambda: request(
        "current", 0x80, "format", ((0xD5, 10), (4, 10), (5, 10))
    ),
    "mip-stream-on": lambda: commands.encode_command(12, commands.Setup.STREAM, b"\x01\x82\x01"),
}


def request(
    family: commands.Family, data_set: int, name: str, outputs: tuple[tuple[int, int], ...] = ()
) -> bytes:
    stream = commands.stream_commands(family, data_set)
    if name == "base_rate":
        return commands.encode_command(12, stream.base_rate, stream.prefix)
    data = b"\x01" + commands.encode_outputs(stream.prefix, outputs)
    return commands.encode_command(12, stream.format, data)


@pytest.mark.skipif(not VECTORS, reason="vectors.json is not here")
@pytest.mark.parametrize("name", REQUESTS)
def test_requests_equal_their_vectors(name: str) -> None:
    (vector,) = (one for one in VECTORS if one["id"] == name)
    assert REQUESTS[name]().hex() == vector["hex"]


# --- the recording ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recording() -> bytes:
    path = SHARED / "microstrain" / "mip_data.bin"
    if not path.is_file():
        pytest.skip(f"real recordings are not here: {path}")
    return path.read_bytes()


def test_the_recording_has_the_counted_content(recording: bytes) -> None:
    found, codec = decode([recording])
    assert (codec.messages, codec.discarded, codec.checksum_failures) == (8384, 0, 0)
    packets = [event for event in found if isinstance(event, MipPacket)]
    assert Counter(packet.descriptor_set for packet in packets) == {
        0x80: 7157, 0x82: 714, 0xA0: 512, 0x01: 1,
    }  # fmt: skip
    contents = Counter(
        (packet.descriptor_set, descriptor) for packet in packets for descriptor, _ in packet.fields
    )
    assert contents == {
        (0x80, 0xD5): 4473, (0x80, 0xD6): 4473, (0x80, 4): 4473, (0x80, 5): 4473, (0x80, 6): 3578,
        (0x80, 0x0C): 1788, (0x82, 0xD5): 714, (0x82, 5): 714, (0xA0, 0xD5): 512,
        (0xA0, 0xD6): 512, (0x01, 0xF1): 1,
    }  # fmt: skip
    combinations = Counter(
        tuple(descriptor for descriptor, _ in packet.fields)
        for packet in packets
        if packet.descriptor_set == 0x80
    )
    assert combinations == {
        (0xD5, 0xD6, 4, 5): 3579, (6,): 1790, (0xD5, 0xD6, 4, 5, 6, 0x0C): 894, (6, 0x0C): 894,
    }  # fmt: skip
    assert {min(p.size for p in packets), max(p.size for p in packets)} == {10, 82}


def test_time_runs_within_a_data_set_and_back_across_sets(recording: bytes) -> None:
    """Packets of different data sets are not sent in the order of their times."""
    times: list[tuple[int, int]] = []
    for packet in packets_in(recording):
        for descriptor, data in packet.fields:
            if descriptor == 0xD5:
                times.append((packet.descriptor_set, int.from_bytes(data, "big")))

    def steps(number: int) -> Counter[int]:
        own = [t_ns for one, t_ns in times if one == number]
        return Counter(b - a for a, b in itertools.pairwise(own))

    assert steps(0x80) == {8_000_000: 4472}
    assert steps(0x82) == {50_000_000: 713}
    assert min(steps(0xA0)) > 0
    assert sum(b < a for (_, a), (_, b) in itertools.pairwise(times)) == 73


DAMAGE: dict[str, tuple[Callable[[bytes], bytes], tuple[int, int, int]]] = {
    "first 5 removed": (lambda wire: wire[5:], (8383, 5, 0)),
    "started at 145690": (lambda wire: wire[145_690:], (5158, 18, 1)),
    "head before packet 100": (
        lambda wire: insert(wire, 100, b"ue\x80\xff"),
        (8384, 4, 1),
    ),
    "last 7 removed": (lambda wire: wire[:-7], (8383, 47, 0)),
}


def insert(wire: bytes, index: int, what: bytes) -> bytes:
    packet = packets_in(wire[:20_000])[index]
    at = packet.end - packet.size
    return wire[:at] + what + wire[at:]


@pytest.mark.parametrize("case", DAMAGE)
@pytest.mark.parametrize("size", [64, 1_000_000])
def test_a_damaged_recording_loses_damaged_packets_only(
    recording: bytes, case: str, size: int
) -> None:
    damage, expected = DAMAGE[case]
    wire = damage(recording)
    _, codec = decode([wire[at : at + size] for at in range(0, len(wire), size)])
    assert (codec.messages, codec.discarded, codec.checksum_failures) == expected
