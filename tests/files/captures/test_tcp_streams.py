"""Captured TCP segments in any order become byte streams, and packets of QTM and Vicon."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

import orjson
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from jointfit_daemon.files.captures._packet_capture import TcpSegment, read_packets
from jointfit_daemon.files.captures._tcp_streams import Piece, directions, split_pieces
from jointfit_daemon.tools.__main__ import app
from jointfit_protocols import qtm, vicon
from tests.drivers.qtm import feeder as of_qtm
from tests.drivers.vicon import feeder as of_vicon
from tests.drivers.vrpn import test_vrpn_decoder as of_vrpn
from tests.files.captures.test_capture import pcap

if TYPE_CHECKING:
    import random
    from collections.abc import Sequence
    from pathlib import Path

SERVER, CLIENT = 801, 50_000
SYN = 2
NUMBERS = 1 << 32


def tcp(payload: bytes, number: int, *, reply: bool = False, flags: int = 0x10) -> bytes:
    """Return a raw IP packet with one segment, from the server unless it is a reply."""
    ports = (CLIENT, SERVER) if reply else (SERVER, CLIENT)
    head = struct.pack(">HHIIBBHHH", *ports, number % NUMBERS, 0, 8 << 4, flags, 0, 0, 0) + bytes(
        12
    )
    body = head + payload
    ends = (b"cccc", b"ssss") if reply else (b"ssss", b"cccc")
    return struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(body), 1, 0, 64, 6, 0, *ends) + body


def segments_of(data: bytes, sizes: Sequence[int], first: int) -> list[bytes]:
    """Return the packets of one connection: its SYN, then `data` in segments of these sizes."""
    found, at = [tcp(b"", first - 1, flags=SYN)], 0
    for size in (*sizes, len(data)):
        found.append(tcp(data[at : at + size], first + at))
        at += size
        if at >= len(data):
            break
    return found


def pieces_of(packets: Sequence[bytes]) -> list[Piece]:
    file = pcap(list(enumerate(packets)), link=101)
    read = [packet for packet in read_packets(file) if isinstance(packet, TcpSegment)]
    return [piece for pieces in directions(read) for piece in pieces]


@given(
    st.binary(min_size=1, max_size=600),
    st.lists(st.integers(1, 40), max_size=30),
    st.sampled_from([5, NUMBERS - 20]),
    st.randoms(use_true_random=False),
)
def test_late_and_repeated_segments_do_not_change_the_bytes(
    data: bytes, sizes: list[int], first: int, dice: random.Random
) -> None:
    begin, *rest = segments_of(data, sizes, first)
    rest += dice.choices(rest, k=3)
    dice.shuffle(rest)
    pieces = pieces_of([begin, *rest])
    assert b"".join(piece.data for piece in pieces) == data
    assert [piece.continues for piece in pieces] == [False] + [True] * (len(pieces) - 1)


def test_a_repetition_with_more_bytes_adds_the_new_ones() -> None:
    packets = [tcp(b"", 99, flags=SYN), tcp(b"abc", 100), tcp(b"abcdef", 100), tcp(b"gh", 106)]
    assert [piece.data for piece in pieces_of(packets)] == [b"abc", b"def", b"gh"]


def test_bytes_after_a_hole_and_a_new_connection_begin_a_run() -> None:
    packets = [tcp(b"abc", 100), tcp(b"ghi", 106), tcp(b"", 699, flags=SYN), tcp(b"xyz", 700)]
    found = [(piece.data, piece.continues) for piece in pieces_of(packets)]
    assert found == [(b"abc", False), (b"ghi", False), (b"xyz", False)]


def test_the_segments_that_wait_are_bounded() -> None:
    packets = [tcp(b"a", 100), *(tcp(b"b", 102 + n) for n in range(400))]
    read = list(read_packets(pcap(list(enumerate(packets)), link=101)))
    (pieces,) = directions(read[:300])  # type: ignore[arg-type]
    assert b"".join(piece.data for piece in pieces) == b"a" + b"b" * 299
    assert sum(not piece.continues for piece in pieces) == 2


@pytest.mark.parametrize("link", [0, 108])
def test_captures_of_the_loopback_interface_are_read(link: int) -> None:
    file = pcap([(0, b"\2\0\0\0" + tcp(b"abc", 7))], link=link)
    (segment,) = read_packets(file)
    assert segment.payload == b"abc"


# --- packets ----------------------------------------------------------------------------------


def test_packets_are_found_again_at_the_segment_after_a_hole() -> None:
    one = qtm.encode(qtm.Command("a" * 30))
    pieces = [Piece(1, one[20:], False), Piece(2, one, True), Piece(3, one[:9], True)]
    chunks = list(split_pieces(pieces, qtm.QtmStream))
    assert [chunk.data for chunk in chunks] == [bytes(len(one) - 20), one, bytes(9)]
    assert [chunk.t_ns for chunk in chunks] == [1, 2, 3]


def summary(driver: str, file: Path, *more: str) -> dict[str, Any]:
    result = CliRunner().invoke(app, ["decode", driver, str(file), "--summary", *more])
    assert result.exit_code == 0, result.stderr
    found: dict[str, Any] = orjson.loads(result.stdout)
    return found


def qtm_wire() -> bytes:
    answers: tuple[qtm.Message, ...] = (
        qtm.Command("QTM RT Interface connected"),
        qtm.Command("Version set to 1.25"),
        qtm.SettingsReply(of_qtm.xml()),
    )
    frames = (
        qtm.DataFrame(10_000 * n, n, (of_qtm.THREE, of_qtm.TWO, of_qtm.camera_time(100_000 * n)))
        for n in range(1, 41)
    )
    return b"".join(qtm.encode(message) for message in (*answers, *frames))


def vicon_wire() -> bytes:
    offer = vicon.encode(vicon.ObjectEnums(frozenset((1, 2, 5, 6, 9, 36))))
    return offer + of_vicon.static() + b"".join(map(of_vicon.frame, range(40)))


def vrpn_wire() -> bytes:
    return of_vrpn.OPENING + b"".join(
        of_vrpn.report(sender, of_vrpn.T0_US + of_vrpn.PERIOD_US * n)
        for n in range(40)
        for sender in of_vrpn.NAMES
    )


WIRES = {"qtm": qtm_wire, "vicon": vicon_wire, "vrpn": vrpn_wire}


@pytest.mark.parametrize("driver", sorted(WIRES))
def test_a_recorded_connection_is_decoded(driver: str, tmp_path: Path) -> None:
    wire = WIRES[driver]()
    other = [tcp(bytes(range(200)), 9000 + 200 * n, reply=True) for n in range(60)]
    packets = segments_of(wire, [700] * 100, 4_294_967_000)
    file = tmp_path / "cameras.pcap"
    file.write_bytes(pcap(list(enumerate([*other[:30], *packets, *other[30:]])), link=101))
    found = summary(driver, file)
    assert found["mocap_frames"] == 40
    assert found["corrupt"] == found["discarded_bytes"] == found["counter_gaps"] == 0

    (tmp_path / "raw.bin").write_bytes(wire)
    raw = summary(driver, tmp_path / "raw.bin")
    assert (raw["mocap_frames"], raw["messages"]) == (40, found["messages"])


def test_a_capture_without_names_states_what_it_must_contain(tmp_path: Path) -> None:
    (tmp_path / "raw.bin").write_bytes(qtm.encode(qtm.DataFrame(1, 1, (of_qtm.TWO,))))
    result = CliRunner().invoke(app, ["decode", "qtm", str(tmp_path / "raw.bin")])
    assert "start to record before jointfitd connects" in result.stderr
