"""SLCAN (Lawicel): CAN frames as ASCII lines on a serial port, for host and adapter.

The stamps of frames are computed from the arrival time that the caller passes. On a serial line,
the duration of the frame's characters and of all later characters is subtracted from the arrival.
On USB, the transmission of the characters takes no measurable time. Instead, the durations on the
CAN bus of the frame and of all later frames in the same read are subtracted, as if the frames had
followed each other without a pause.

    t iii l dd...    11-bit frame, l bytes     T iiiiiiii l dd...   29-bit frame
    r iii l          11-bit remote request     R iiiiiiii l         29-bit remote request

Every line ends with CR; LF is ignored. A frame may be followed by four digits of adapter time in
ms, modulo 60 000. The digits are dropped, because they refer to another clock. The adapter answers
a command with CR (done) or BELL (refused). The commands of the host include ``Sn`` (bit rate),
``O`` (open), ``C`` (close), ``V`` (version), ``N`` (serial number) and ``Z`` (adapter time).

Source: Lawicel CAN232 manual, version 3.

Invariant: the codec converts bytes to frames and lines. It uses no port and no clock.
"""

from __future__ import annotations

from binascii import unhexlify
from typing import Literal, NamedTuple

from jointfit_protocols.can._frame import EXTENDED_MAX, STANDARD_MAX, CanFrame, frame_bits
from jointfit_protocols.corrupt import CorruptBytes

Role = Literal["host", "adapter"]
"""Role of the codec. A host reads answers, and an adapter reads commands; both read frames."""

BITRATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)
"""Bit rates that the commands S0 to S8 select, bit/s."""

DONE, REFUSED = b"\r", b"\a"
_BELL = 0x07
_LONGEST = 64
"""Number of characters of the longest line. Some adapters have long version strings."""
_WINDOW = 32
"""Number of characters at the end of a corrupt line that are searched for a frame. The longest
frame has 30."""
_BITS_A_CHARACTER = 10
"""Number of bits of one character on the line (8N1)."""

# Letters of lines without a frame, and the permitted lengths of their arguments.
_ANSWERS: dict[int, range] = {
    ord("V"): range(1, 41),
    ord("v"): range(1, 41),
    ord("N"): range(1, 41),
    ord("F"): range(2, 3),
    ord("z"): range(1),
    ord("Z"): range(1),
}
_COMMANDS: dict[int, range] = {
    **dict.fromkeys(b"OLlCVvNFAPX", range(2)),
    **dict.fromkeys(b"SZUQW", range(1, 3)),
    ord("s"): range(4, 7),
    ord("m"): range(8, 9),
    ord("M"): range(8, 9),
}


class SlcanLine(NamedTuple):
    """A line that contains an answer or a command instead of a frame."""

    letter: str
    """First letter of the line. ``""`` means a single CR (done), and ``"\\a"`` means BELL
    (refused)."""
    argument: str = ""


def encode_frame(frame: CanFrame, time_ms: int | None = None) -> bytes:
    """Return `frame` as a line.

    If `time_ms` is given, the line ends with the adapter time: `time_ms` modulo 60 000, in four
    hexadecimal digits.
    """
    letter = ("rR" if frame.remote else "tT")[frame.extended]

    head = f"{letter}{frame.can_id:0{8 if frame.extended else 3}X}{len(frame.data)}"
    body = "" if frame.remote else frame.data.hex().upper()
    stamp = "" if time_ms is None else f"{time_ms % 60_000:04X}"
    return f"{head}{body}{stamp}\r".encode()


def _frame(line: bytes, t_ns: int) -> CanFrame | None:
    """Return the frame in `line` (without CR); None if the line is not exactly one frame."""
    letter = line[0]
    extended = letter in b"TR"
    try:
        # All digits are converted at once. The conversion is strict: no signs, spaces or
        # underscores.
        raw = unhexlify(b"0" + line[1:] if extended else line[1:])
    except ValueError:
        return None

    head = 5 if extended else 2
    if len(raw) < head:
        return None

    number = int.from_bytes(raw[:head], "big")
    can_id, size = number >> 4, number & 0xF
    remote = letter in b"rR"
    end = head if remote else head + size
    if size > 8 or len(raw) not in {end, end + 2}:  # noqa: PLR2004 - classic CAN
        return None
    if can_id > (EXTENDED_MAX if extended else STANDARD_MAX):
        return None
    return CanFrame(t_ns, can_id, raw[head:end], extended, error=False, remote=remote)


class SlcanCodec:
    """Codec that converts byte strings of any size to frames and lines; it never raises.

    Parameters
    ----------
    baud : int, optional
        Speed of the serial line, bit/s. One character lasts 10/baud seconds. None for USB.
    role : Role
        ``host`` to read from an adapter, ``adapter`` to read from a host.
    bitrate : int
        Bit rate of the CAN bus, bit/s.
    """

    def __init__(
        self, baud: int | None, role: Role = "host", *, bitrate: int = BITRATES[-1]
    ) -> None:
        self._character_ns = 0.0 if baud is None else _BITS_A_CHARACTER * 1_000_000_000 / baud
        self._bit_ns = 1_000_000_000 / bitrate
        self._lines = _ANSWERS if role == "host" else _COMMANDS
        self._pending = b""  # at most one line, _LONGEST bytes
        self._endless = False  # the pending line has lost its beginning
        self._previous_ns: int | None = None
        self.frames = 0
        self.discarded_bytes = 0

    def feed(self, data: bytes, t_ns: int) -> list[CanFrame | SlcanLine | CorruptBytes]:
        """Return the frames and lines that `data` completes, in wire order.

        The ``t_ns`` of a frame is the start of its line. It is the arrival `t_ns` minus the
        duration of all characters from the start of the line on. On USB, the durations on the bus
        of this frame and of all later frames in `data` are subtracted instead. The stamp of a line
        that lies completely in `data` is never earlier than the `t_ns` of the previous call.
        """
        found: list[CanFrame | SlcanLine | CorruptBytes] = []
        *lines, rest = (self._pending + data).replace(b"\n", b"").split(b"\r")
        before = len(self._pending)  # bytes of earlier calls
        # duration from a line's start to the end of `data`
        after_ns = (before + len(data)) * self._character_ns or sum(map(self._on_bus_ns, lines))

        for line in lines:
            floor = self._previous_ns if before <= 0 else None
            start = t_ns - round(after_ns)
            self._decode_line(line, start if floor is None or start > floor else floor, found)
            after_ns -= (len(line) + 1) * self._character_ns or self._on_bus_ns(line)
            before -= len(line) + 1

        # An overlong line is shortened to its last `_WINDOW` characters, because a frame may have
        # begun in them.
        rest = self._split_bells(rest, found)
        if len(rest) > _LONGEST:
            self._endless = True
            found.append(self._corrupt(len(rest) - _WINDOW, "line without end"))
            rest = rest[-_WINDOW:]
        self._pending, self._previous_ns = rest, t_ns
        return found

    def flush(self) -> list[CorruptBytes]:
        """Discard an incomplete line."""
        rest, self._pending, self._endless = self._pending, b"", False
        return [self._corrupt(len(rest), "unfinished line")] if rest else []

    def _on_bus_ns(self, line: bytes) -> float:
        """Return the duration of a line's frame on the bus, ns; 0 for lines without a frame."""
        if not line or line[0] not in b"tTrR":
            return 0.0
        extended = line[0] in b"TR"
        digit = line[9:10] if extended else line[4:5]
        size = int(digit) if digit.isdigit() and line[0] in b"tT" else 0
        return frame_bits(min(size, 8), extended) * self._bit_ns

    def _split_bells(self, line: bytes, found: list[CanFrame | SlcanLine | CorruptBytes]) -> bytes:
        """Return the rest of `line` after its last BELL, which is an answer without CR."""
        while _BELL in line:
            junk, line = line.split(REFUSED, 1)
            if junk:
                found.append(self._corrupt(len(junk), "cut line"))
            found.append(SlcanLine("\a"))
            self._endless = False
        return line

    def _decode_line(
        self, line: bytes, t_ns: int, found: list[CanFrame | SlcanLine | CorruptBytes]
    ) -> None:
        """Append the frame, answer or command in `line` (without CR)."""
        if line and line[0] in b"tTrR":
            frame = _frame(line, t_ns)
            if frame is not None:
                self.frames += 1
                self._endless = False
                found.append(frame)
                return

        line = self._split_bells(line, found)
        endless, self._endless = self._endless, False
        if not line:
            found.append(SlcanLine(""))
        elif not endless and line.isascii() and len(line) - 1 in self._lines.get(line[0], ()):
            found.append(SlcanLine(chr(line[0]), line[1:].decode()))
        else:
            self._recover_frame(line, t_ns, found)

    def _recover_frame(
        self, line: bytes, t_ns: int, found: list[CanFrame | SlcanLine | CorruptBytes]
    ) -> None:
        """Append the frame at the end of a corrupt `line`, if there is one.

        Noise may precede the frame.
        """
        for at in range(max(0, len(line) - _WINDOW), len(line)):
            if line[at] in b"tTrR":
                frame = _frame(line[at:], t_ns + round(at * self._character_ns))
                if frame is not None:
                    self.frames += 1
                    found += [self._corrupt(at, "no SLCAN line"), frame]
                    return
        found.append(self._corrupt(len(line) + 1, "no SLCAN line"))

    def _corrupt(self, count: int, reason: str) -> CorruptBytes:
        self.discarded_bytes += count
        return CorruptBytes(count, reason)
