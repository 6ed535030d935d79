"""Second reader of ``candump -L`` logs (can-utils), for comparison with the daemon's reader.

    (1436509052.249713) vcan0 044#2A366C2BBA        (time) interface id#data
    (1436509052.449847) vcan0 0F6#R                 remote request
    (1436509052.449847) vcan0 19FF0021#7FFF00       eight digits: 29-bit identifier

Invariant: a line that is no frame becomes `CorruptBytes` of its length and affects no other line.
"""

from __future__ import annotations

from binascii import unhexlify
from typing import TYPE_CHECKING

from jointfit_protocols.can import EXTENDED_MAX, STANDARD_MAX, CanFrame
from jointfit_protocols.corrupt import CorruptBytes

if TYPE_CHECKING:
    from collections.abc import Iterator

_ERROR_FLAG = 0x2000_0000
_EXTENDED_DIGITS = 8
_NS_DIGITS = 9


def parse_candump(log: bytes) -> list[CanFrame | CorruptBytes]:
    """Return the frames of a ``candump -L`` log; ``t_ns`` is the log's own time, ns.

    Empty lines and lines that begin with ``#`` are skipped. CAN FD frames are corrupt, because no
    supported device sends them.
    """
    return list(_parsed(log))


def _parsed(log: bytes) -> Iterator[CanFrame | CorruptBytes]:
    for line in log.splitlines(keepends=True):
        text = line.strip()
        if text and not text.startswith(b"#"):
            frame = _frame(text)
            yield frame if frame is not None else CorruptBytes(len(line), "no candump -L line")


def _frame(line: bytes) -> CanFrame | None:
    """Return the frame in `line`; None if the line contains no frame."""
    words = line.split()
    if len(words) < 3:
        return None

    t_ns = _time_ns(words[0])
    digits, mark, body = words[2].partition(b"#")
    if t_ns is None or not mark or len(digits) not in {3, _EXTENDED_DIGITS}:
        return None

    remote = body.startswith(b"R")
    try:
        number = int.from_bytes(unhexlify(digits.zfill(_EXTENDED_DIGITS)), "big")
        data = b"" if remote else unhexlify(body)
    except ValueError:
        return None

    error, extended = bool(number & _ERROR_FLAG), len(digits) == _EXTENDED_DIGITS
    number &= ~_ERROR_FLAG
    if len(data) > 8 or number > (EXTENDED_MAX if extended else STANDARD_MAX):
        return None
    return CanFrame(t_ns, number, data, extended and not error, error, remote)


def _time_ns(word: bytes) -> int | None:
    """Return ``(seconds.fraction)`` in ns, exactly; None if the word has another form."""
    if not (word.startswith(b"(") and word.endswith(b")")):
        return None

    seconds, _, fraction = word[1:-1].partition(b".")
    if not seconds.isdigit() or not (fraction.isdigit() or not fraction):
        return None
    if len(seconds) > 10 or len(fraction) > _NS_DIGITS:
        return None
    return int(seconds) * 1_000_000_000 + int(fraction.ljust(_NS_DIGITS, b"0") or b"0")
