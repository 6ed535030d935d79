"""Captures of every type are converted to chunks."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.files.captures import read_capture
from jointfit_daemon.files.captures._candump import read_candump
from jointfit_daemon.files.captures._capture import UnreadableCaptureError
from jointfit_daemon.files.captures._packet_capture import read_packets
from jointfit_protocols.can import CanFrame, host_count, unpack_frames
from jointfit_protocols.corrupt import CorruptBytes
from tests.captured_datagrams import read_udp
from tests.protocols.can.candump_oracle import parse_candump

if TYPE_CHECKING:
    from pathlib import Path


def udp(payload: bytes, source: int = 1510, target: int = 40000) -> bytes:
    return struct.pack(">HHHH", source, target, 8 + len(payload), 0) + payload


def ip(body: bytes, number: int = 1, flags: int = 0) -> bytes:
    head = struct.pack(
        ">BBHHHBBH4s4s", 0x45, 0, 20 + len(body), number, flags, 64, 17, 0, b"aaaa", b"bbbb"
    )
    return head + body


def ipv6(body: bytes, next_header: int = 17) -> bytes:
    return struct.pack(">IHBB", 6 << 28, len(body), next_header, 64) + bytes(range(32)) + body


def ethernet(packet: bytes, vlan: bool = False) -> bytes:
    kind = b"\x86\xdd" if packet[0] >> 4 == 6 else b"\x08\x00"
    return bytes(12) + (b"\x81\x00\x00\x05" if vlan else b"") + kind + packet


def pcap(frames: list[tuple[int, bytes]], order: str = "<", link: int = 1) -> bytes:
    parts = [struct.pack(order + "IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, link)]
    for t_us, frame in frames:
        stamp = divmod(t_us, 10**6)
        parts += [struct.pack(order + "IIII", *stamp, len(frame), len(frame)), frame]
    return b"".join(parts)


def block(kind: int, body: bytes, order: str) -> bytes:
    body += bytes(-len(body) % 4)
    size = struct.pack(order + "I", 12 + len(body))
    return struct.pack(order + "I", kind) + size + body + size


def pcapng(frames: list[tuple[int, bytes]], order: str, resolution: int) -> bytes:
    section = struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1)
    options = struct.pack(order + "HHB3xHHq", 9, 1, resolution, 14, 8, 5) + bytes(4)
    parts = [block(0x0A0D0D0A, section, order)]
    parts.append(block(1, struct.pack(order + "HHI", 1, 0, 0) + options, order))
    for ticks, frame in frames:
        head = struct.pack(order + "5I", 0, ticks >> 32, ticks & 0xFFFFFFFF, len(frame), len(frame))
        parts.append(block(6, head + frame, order))
    parts.append(block(5, bytes(12), order))
    return b"".join(parts)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("vlan", [False, True])
def test_a_pcap_file_gives_its_udp_payloads(order: str, vlan: bool) -> None:
    file = pcap([(1_500_000, ethernet(ip(udp(b"hello")), vlan))], order)
    (packet,) = read_udp(file)
    assert packet == (1_500_000_000, 1510, 40000, b"hello")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    ("resolution", "t_ns"), [(6, 7_000_000), (9, 7_000), (0x80 | 10, 6_835_937_500)]
)
def test_a_pcapng_file_keeps_the_time_of_its_interface(
    order: str, resolution: int, t_ns: int
) -> None:
    file = pcapng([(7000, ethernet(ip(udp(b"x"))))], order, resolution)
    (packet,) = read_udp(file)
    assert packet.t_ns == 5 * 10**9 + t_ns


@pytest.mark.parametrize("vlan", [False, True])
def test_udp_payloads_over_ipv6_are_read_behind_extension_headers(vlan: bool) -> None:
    options = b"\x3c\0" + bytes(6) + b"\x11\x01" + bytes(14)  # hop-by-hop, then destination
    packets = [ipv6(udp(b"plain")), ipv6(options + udp(b"behind"), 0), ipv6(udp(b"x"), 58)]
    frames = [(0, ethernet(packet, vlan)) for packet in packets]
    assert [packet.payload for packet in read_udp(pcap(frames))] == [b"plain", b"behind"]
    raw = pcap([(0, packet) for packet in packets], link=101)
    assert [packet.payload for packet in read_udp(raw)] == [b"plain", b"behind"]


def test_tcp_segments_over_ipv6_have_both_addresses() -> None:
    body = struct.pack(">HHIIBB6x", 801, 40_000, 7, 0, 0x50, 0) + b"bytes"
    (segment,) = read_packets(pcap([(0, ethernet(ipv6(body, 6)))]))
    source, target = (bytes(range(16)), 801), (bytes(range(16, 32)), 40_000)
    assert segment == (0, source, target, 7, False, b"bytes")


def test_ipv6_fragments_are_put_together() -> None:
    whole = udp(bytes(range(256)) * 10)
    frames = [
        (n, ethernet(ipv6(struct.pack(">BxHI", 17, at | more, 9) + whole[at:end], 44)))
        for n, (at, end, more) in enumerate([(1448, len(whole), 0), (0, 1448, 1)])
    ]
    (packet,) = read_udp(pcap(frames))
    assert packet.payload == whole[8:]


@given(st.binary(max_size=100), st.sampled_from([0, 6, 17, 43, 44, 51, 60]))
def test_any_ipv6_packet_ends_quietly(data: bytes, next_header: int) -> None:
    """No IPv6 packet raises an exception."""
    list(read_udp(pcap([(0, ethernet(ipv6(data, next_header)[: 20 + len(data)]))])))


def test_fragments_are_put_together_in_any_order() -> None:
    whole = udp(bytes(range(256)) * 10)
    cuts = [(0, 1480), (1480, 2000), (2000, len(whole))]
    frames = [
        (n, ethernet(ip(whole[a:b], 9, (0x2000 if b < len(whole) else 0) | a // 8)))
        for n, (a, b) in enumerate(cuts)
    ]
    for order in ((0, 1, 2), (2, 0, 1), (1, 2, 0)):
        (packet,) = read_udp(pcap([frames[i] for i in order]))
        assert packet.payload == whole[8:]
    assert not list(read_udp(pcap(frames[:2])))


@given(st.binary(max_size=200), st.sampled_from([b"\x0a\x0d\x0d\x0a", b"\xd4\xc3\xb2\xa1"]))
def test_any_bytes_end_quietly(data: bytes, magic: bytes) -> None:
    """No bytes after the start of a capture file raise an exception."""
    list(read_udp(magic + data))


@given(st.integers(0, 400))
def test_a_truncated_file_yields_its_complete_records(cut: int) -> None:
    frames = [(n, ethernet(ip(udp(bytes([n]))))) for n in range(3)]
    for file in (pcap(frames), pcapng(frames, "<", 6)):
        payloads = [packet.payload for packet in read_udp(file[: max(4, len(file) - cut)])]
        assert payloads == [b"\0", b"\1", b"\2"][: len(payloads)]


def test_the_real_capture_holds_550_datagrams(shared_data: Path) -> None:
    path = shared_data / "mocap" / "natnet_v3_mje-nz" / "test_data" / "raw" / "traffic.pcapng"
    chunks = list(read_capture(path, "datagram"))
    assert len(chunks) == 550
    assert sum(len(chunk.data) == 336 for chunk in chunks) == 518
    assert [chunk.t_ns for chunk in chunks] == sorted(chunk.t_ns for chunk in chunks)
    assert sum(1 for _ in read_capture(path, "datagram", port=1511)) == 518


LOG = b"""# a comment
(1436509052.249713) vcan0 044#2A366C2B
(1436509052.449847) vcan0 0F6#R
(1436509053.1) vcan0 19FF0021#7FFF00
(1436509053.2) vcan0 7F1#

(1436509053.3) vcan0 20000004#0001000000000000
"""


def test_candump_text_becomes_the_records_of_the_codec() -> None:
    chunks = list(read_candump(LOG))
    found = [frame for chunk in chunks for frame in unpack_frames(chunk.data)]
    assert found == parse_candump(LOG)
    assert [chunk.t_ns for chunk in chunks] == [frame.t_ns for frame in found]  # type: ignore[union-attr]


def test_candump_text_without_the_option_for_logs_has_the_same_frames(tmp_path: Path) -> None:
    text = (
        b" (1.500000)  can0  181   [4]  88 13 78 EC\n"
        b" (1.600000)  can0  RX - -  19FF0021   [2]  0A FF   '..'\n"
        b"  vcan0  181   [0]  remote request\n  can0  7FF   [1]  05\n"
    )
    (tmp_path / "log").write_bytes(text)
    found = [unpack_frames(one.data)[0] for one in read_capture(tmp_path / "log", "can")]
    assert found == [
        CanFrame(1_500_000_000, 0x181, bytes.fromhex("881378ec")),
        CanFrame(1_600_000_000, 0x19FF0021, b"\n\xff", extended=True),
        CanFrame(1_600_000_000, 0x181, b"", remote=True),
        CanFrame(1_600_000_000, 0x7FF, b"\x05"),
    ]


@pytest.mark.parametrize("order", ["<", ">"])
def test_packets_without_time_and_old_packets_of_pcapng_are_read(order: str) -> None:
    frame = ethernet(ip(udp(b"hello")))
    old = struct.pack(order + "HHIIII", 0, 7, 0, 3_000_000, len(frame), len(frame)) + frame
    simple = struct.pack(order + "I", len(frame)) + frame
    cut = struct.pack(order + "I", len(frame) + 99) + frame
    file = pcapng([], order, 6) + block(2, old, order) + block(3, simple, order)
    found = list(read_udp(file + block(3, cut, order) + block(3, b"", order)))
    assert [packet.payload for packet in found] == [b"hello"] * 3
    assert {packet.t_ns for packet in found} == {8 * 10**9}


@pytest.mark.parametrize(
    ("link", "head"), [(227, b""), (113, bytes(14) + b"\0\x0c"), (276, b"\0\x0c" + bytes(18))]
)
def test_can_frames_of_a_network_capture_become_records(
    tmp_path: Path, link: int, head: bytes
) -> None:
    words = [
        (0x181, b"\1\2"),
        (1 << 31 | 0x19FF0021, bytes(8)),
        (1 << 30 | 5, b""),
        (1 << 29 | 4, bytes(8)),
    ]
    frames = [head + struct.pack(">IB3x", word, len(data)) + data for word, data in words]
    frames += [head + b"\0\0\1\x81\x08\0\0\0cut", *([bytes(40)] if head else [])]
    (tmp_path / "c").write_bytes(pcap([(1_000, frame) for frame in frames], link=link))
    found = [unpack_frames(one.data)[0] for one in read_capture(tmp_path / "c", "can")]
    assert found == [
        CanFrame(1_000_000, 0x181, b"\1\2"),
        CanFrame(1_000_000, 0x19FF0021, bytes(8), extended=True),
        CanFrame(1_000_000, 5, b"", remote=True),
        CanFrame(1_000_000, 4, bytes(8), error=True),
    ]


@pytest.mark.parametrize(
    "line",
    [b"(1.5) can0 105##1AABB\n", b"garbage\n", b"(1.5) can0 999#00\n", b"(1.5) can0 105#0\n"],
)
def test_a_line_without_a_frame_is_counted_by_its_length(line: bytes) -> None:
    (wanted,) = parse_candump(line)
    assert isinstance(wanted, CorruptBytes)
    (chunk,) = read_candump(line)
    (note,) = unpack_frames(chunk.data)
    assert not isinstance(note, CorruptBytes)
    assert host_count(note) == wanted.discarded == len(line)


@given(st.binary(max_size=100))
def test_any_text_gives_records_the_codec_accepts(data: bytes) -> None:
    for chunk in read_candump(data):
        assert not any(isinstance(frame, CorruptBytes) for frame in unpack_frames(chunk.data))


def test_raw_bytes_of_a_stream_come_in_pieces_with_time_going_on(tmp_path: Path) -> None:
    (tmp_path / "raw.bin").write_bytes(bytes(10_000))
    chunks = list(read_capture(tmp_path / "raw.bin", "stream"))
    assert [len(chunk.data) for chunk in chunks] == [4096, 4096, 1808]
    assert chunks[0].t_ns < chunks[1].t_ns < chunks[2].t_ns


def test_raw_datagrams_are_walked_by_length_only_if_that_fits(tmp_path: Path) -> None:
    two = b"\x0a\0\1\0a" + b"\x0a\0\2\0bc"
    for data, pieces in ((two, [two[:5], two[5:]]), (two + b"x", [two + b"x"])):
        (tmp_path / "raw.bin").write_bytes(data)
        chunks = list(read_capture(tmp_path / "raw.bin", "datagram"))
        assert [chunk.data for chunk in chunks] == pieces


@pytest.mark.parametrize(
    ("data", "wire", "found"),
    [
        (LOG, "stream", "candump text"),
        (pcap([]), "can", "a network capture"),
        (b"12345", "can", "neither"),
    ],
)
def test_the_wrong_kind_of_file_is_refused_by_name(
    tmp_path: Path, data: bytes, wire: str, found: str
) -> None:
    (tmp_path / "f").write_bytes(data)
    with pytest.raises(UnreadableCaptureError, match=found):
        read_capture(tmp_path / "f", wire)  # type: ignore[arg-type]
