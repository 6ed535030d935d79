"""The SLCAN codec as host and as adapter: frames, lines, corrupt bytes and stamps."""

from __future__ import annotations

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from jointfit_protocols.can import CanFrame
from jointfit_protocols.can.slcan import (
    BITRATES,
    Role,
    SlcanCodec,
    SlcanLine,
    encode_frame,
)
from jointfit_protocols.corrupt import CorruptBytes

payloads = st.binary(max_size=8)


def frames_of(
    kind: str, largest: int, data: st.SearchStrategy[bytes]
) -> st.SearchStrategy[CanFrame]:
    flags = {flag: st.just(flag == kind) for flag in ("extended", "error", "remote")}
    return st.builds(CanFrame, st.just(0), st.integers(0, largest), data, **flags)


standard = frames_of("standard", 0x7FF, payloads)
extended = frames_of("extended", 0x1FFFFFFF, payloads)
remote = frames_of("remote", 0x7FF, st.just(b""))
can_frames = standard | extended | remote
lines = st.builds(encode_frame, can_frames, st.none() | st.integers(0, 10**6))
answers = st.sampled_from([b"\r", b"\a", b"V1013\r", b"z\r", b"NA123\r"])
junk = st.binary(max_size=80) | st.text("tTrR0123456789ABCDEF\r\a\n", max_size=80).map(str.encode)
wires = st.lists(lines | answers | junk).map(b"".join)
roles = st.sampled_from(["host", "adapter"])


def decoded(chunks: list[bytes], role: Role = "host") -> tuple[list[CanFrame | SlcanLine], int]:
    decoder = SlcanCodec(115_200, role)
    found = [item for chunk in chunks for item in decoder.feed(chunk, 0)] + decoder.flush()
    lost = sum(item.discarded for item in found if isinstance(item, CorruptBytes))
    assert lost == decoder.discarded_bytes
    good = [item for item in found if not isinstance(item, CorruptBytes)]
    assert decoder.frames == sum(isinstance(item, CanFrame) for item in good)
    return [i._replace(t_ns=0) if isinstance(i, CanFrame) else i for i in good], lost


@given(wires, roles)
@example(b"V" * 70 + b"\r", "host")
@example(b"x" * 100 + b"t0212ABCD\r", "host")
def test_chunking_changes_neither_messages_nor_losses(wire: bytes, role: Role) -> None:
    assert decoded([wire], role) == decoded([bytes([byte]) for byte in wire], role)


@given(wires, roles)
def test_no_more_bytes_are_lost_than_arrived(wire: bytes, role: Role) -> None:
    messages, lost = decoded([wire], role)
    assert lost + len(messages) <= len(wire)


@given(st.lists(can_frames), st.booleans())
def test_frames_survive_a_round_trip_in_both_roles(frames: list[CanFrame], timed: bool) -> None:
    wire = b"".join(encode_frame(frame, 59_999 if timed else None) for frame in frames)
    for role in ("host", "adapter"):
        assert decoded([wire], role) == (frames, 0)


@given(st.text("xyz#$% \x00", max_size=60).map(str.encode), can_frames)
def test_a_frame_behind_noise_is_not_lost(noise: bytes, frame: CanFrame) -> None:
    assert decoded([noise + encode_frame(frame)]) == ([frame], len(noise))


@given(st.binary(max_size=5000))
def test_pending_bytes_are_bounded(data: bytes) -> None:
    decoder = SlcanCodec(115_200)
    decoder.feed(data.replace(b"\r", b"x"), 0)
    assert sum(item.discarded for item in decoder.flush()) <= 64


def test_other_characters_than_hexadecimal_digits_are_refused() -> None:
    for bad in (b"t0212AB C\r", b"t021 2ABCD\r", b"t+212ABCD\r", b"t0_12ABCD\r", b"t0212ABCG\r"):
        messages, lost = decoded([bad])
        assert not messages
        assert lost == len(bad)


def test_ranges_are_checked() -> None:
    for bad in (b"t80010\r", b"T200000000\r", b"t0219" + b"00" * 9 + b"\r", b"t02124\r"):
        assert not decoded([bad])[0]


def test_an_answer_inside_a_line_ends_it() -> None:
    """The answer BEL ends the line t02, which is lost."""
    assert decoded([b"t02\aV1013\r\r"]) == (
        [SlcanLine("\a"), SlcanLine("V", "1013"), SlcanLine("")],
        3,
    )


def test_slcan_commands_are_distinguished_from_answers() -> None:
    wire = b"C\rS8\rO\rV\r"
    assert decoded([wire], "adapter")[0] == [
        SlcanLine("C"), SlcanLine("S", "8"), SlcanLine("O"), SlcanLine("V"),
    ]  # fmt: skip
    assert decoded([wire], "host") == ([], len(wire))


def test_a_frame_is_stamped_at_the_start_of_its_line() -> None:
    decoder = SlcanCodec(100_000)  # a character in 100 us
    frame = CanFrame(0, 0x21, b"\1\2\3\4\5\6\7\x08")
    line = encode_frame(frame)  # 22 characters
    found = decoder.feed(line + line + b"t02", 1_000_000_000)
    assert [item.t_ns for item in found if isinstance(item, CanFrame)] == [
        1_000_000_000 - 47 * 100_000,
        1_000_000_000 - 25 * 100_000,
    ]
    (rest,) = decoder.feed(line[3:], 1_001_900_000)
    assert isinstance(rest, CanFrame)
    assert rest.t_ns == 1_001_900_000 - 22 * 100_000


def test_a_line_that_came_whole_is_not_stamped_before_the_previous_read() -> None:
    decoder = SlcanCodec(9_600)  # the configured speed; the adapter on USB is much faster
    line = encode_frame(CanFrame(0, 0x21, bytes(8)))
    decoder.feed(line, 1_000_000_000)
    (frame,) = decoder.feed(line, 1_001_000_000)
    assert isinstance(frame, CanFrame)
    assert frame.t_ns == 1_000_000_000


def test_the_nine_bit_rates_are_those_of_the_manual() -> None:
    assert tuple(rate / 1000 for rate in BITRATES) == (10, 20, 50, 100, 125, 250, 500, 800, 1000)


@pytest.mark.parametrize(
    ("frame", "time_ms", "line"),
    [
        (CanFrame(0, 0x21, b"\xab\xcd"), None, b"t0212ABCD\r"),
        (CanFrame(0, 0x21, b"\xab\xcd"), 59_999, b"t0212ABCDEA5F\r"),
        (CanFrame(0, 0x21, b"\xab\xcd"), 60_001, b"t0212ABCD0001\r"),
        (CanFrame(0, 0x21, b"", extended=True), None, b"T000000210\r"),
        (CanFrame(0, 0x7FF, b"", remote=True), None, b"r7FF0\r"),
        (CanFrame(0, 0x1FFF_FFFF, b"", extended=True, remote=True), None, b"R1FFFFFFF0\r"),
    ],
)
def test_lines_have_the_form_of_the_manual(
    frame: CanFrame, time_ms: int | None, line: bytes
) -> None:
    assert encode_frame(frame, time_ms) == line
    assert decoded([line]) == ([frame], 0)


@pytest.mark.parametrize(
    ("role", "letters", "least", "most"),
    [
        ("host", "VvN", 1, 40),
        ("host", "F", 2, 2),
        ("host", "zZ", 0, 0),
        ("adapter", "OlLCVvNFAPX", 0, 1),
        ("adapter", "SZUQW", 1, 2),
        ("adapter", "s", 4, 6),
        ("adapter", "mM", 8, 8),
    ],
)
def test_arguments_have_the_lengths_of_the_manual(
    role: Role, letters: str, least: int, most: int
) -> None:
    for letter in letters:
        for count in range(max(least - 1, 0), most + 2):
            line, argument = f"{letter}{'1' * count}\r".encode(), "1" * count
            accepted = [SlcanLine(letter, argument)] if least <= count <= most else []
            assert decoded([line], role) == (accepted, 0 if accepted else len(line))


def test_frames_of_one_read_over_usb_are_stamped_by_their_duration_on_the_bus() -> None:
    decoder = SlcanCodec(None, bitrate=500_000)  # a bit in 2 us
    frames = [
        CanFrame(0, 0x21, bytes(8)),  # 111 bits
        CanFrame(0, 0x21, bytes(8), extended=True),  # 131 bits
        CanFrame(0, 0x21, b"", remote=True),  # 47 bits
    ]
    found = decoder.feed(b"z\r" + b"".join(map(encode_frame, frames)) + b"\r", 1_000_000_000)
    assert [item.t_ns for item in found if isinstance(item, CanFrame)] == [
        1_000_000_000 - 289 * 2000, 1_000_000_000 - 178 * 2000, 1_000_000_000 - 47 * 2000,
    ]  # fmt: skip
    (late,) = decoder.feed(encode_frame(frames[0]), 1_000_000_001)
    assert isinstance(late, CanFrame)
    assert late.t_ns == 1_000_000_000  # not before the previous read


def test_a_frame_behind_noise_is_stamped_at_its_own_start() -> None:
    decoder = SlcanCodec(100_000)  # a character in 100 us
    line = encode_frame(CanFrame(0, 0x21, b"ab"))  # 10 characters
    noise, frame = decoder.feed(b"xyz" + line, 1_000_000_000)
    assert noise == (3, "no SLCAN line")
    assert isinstance(frame, CanFrame)
    assert frame.t_ns == 1_000_000_000 - 10 * 100_000


def test_a_line_without_end_loses_all_but_its_last_32_characters() -> None:
    decoder = SlcanCodec(None)
    assert decoder.feed(b"x" * 64, 0) == []
    assert decoder.feed(b"x", 0) == [(33, "line without end")]
    assert decoder.flush() == [(32, "unfinished line")]
    assert decoder.discarded_bytes == 65


def test_the_bus_runs_at_one_megabit_by_default() -> None:
    (frame,) = SlcanCodec(None).feed(encode_frame(CanFrame(0, 1, bytes(8))), 0)
    assert isinstance(frame, CanFrame)
    assert frame.t_ns == -111_000
