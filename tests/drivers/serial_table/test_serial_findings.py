"""Bytes that do not fit their table: the report names the key and the value that fit."""

from __future__ import annotations

from typing import Any

import pytest

from jointfit_drivers.serial_table._findings import explain_bytes
from jointfit_protocols.table import (
    Checksum,
    FrameFormat,
    LineFormat,
    TableField,
    encode_frame,
    encode_line,
)

FIELDS = {slot: TableField(4 + 2 * slot, "i", 16) for slot in range(4)}
FRAME = FrameFormat(b"\xaa\x55", FIELDS, 13, checksum=Checksum("sum8", 2))
BY_LENGTH = FRAME._replace(length=TableField(2, "u", 8), length_adds=5)
LINE = LineFormat({slot: slot for slot in range(4)}, prefix=b"Q,", width=4)


def sent(form: FrameFormat | LineFormat) -> bytes:
    """Return a stream that starts within a message."""
    encode: Any = encode_line if isinstance(form, LineFormat) else encode_frame
    return b"".join(encode(form, [number, 2000, -3000, 4000 + number]) for number in range(40))[3:]


@pytest.mark.parametrize(
    ("table", "device", "expected"),
    [
        (FRAME._replace(length=15), FRAME, "after 13 bytes, expected 15: set `frame.length` = 13"),
        (FRAME, FRAME._replace(sync=b"\x5a\xa5"), "sync bytes AA 55 hardly occur"),
        (
            FRAME,
            FRAME._replace(checksum=Checksum("xor8", 2)),
            'the data fit kind = "xor8", first = 2: correct `frame.checksum`',
        ),
        (
            FRAME._replace(length=14, checksum=Checksum("crc16", 2)),
            FRAME._replace(
                length=14,
                checksum=Checksum(
                    "crc16", 0, "big", polynomial=0x8005, init=0xFFFF, reflected=True
                ),
            ),
            'kind = "crc16", byte_order = "big", polynomial = 0x8005, init = 0xFFFF, reflected',
        ),
        (BY_LENGTH._replace(length_adds=3), BY_LENGTH, "set `frame.length_field.adds` = 5"),
        (
            FRAME._replace(message=(TableField(2, "u", 8), 7)),
            FRAME._replace(message=(TableField(2, "u", 8), 4)),
            "frames have the type 4, expected 7: correct `frame.message.equals`",
        ),
        (
            FRAME._replace(length=14, end=b"\x0d", checksum=None),
            FRAME._replace(length=14, end=b"\x0a", checksum=None),
            "frames of 14 bytes do not end with 0D: correct `frame.end`",
        ),
        (
            BY_LENGTH._replace(fields=FIELDS | {4: TableField(16, "i", 16)}),
            BY_LENGTH,
            "sync bytes AA 55 follow each other after 13 bytes, but the frames do not fit",
        ),
        (FRAME, LINE, "they are text"),
        (LINE, FRAME, "they are not text"),
        (LINE._replace(prefix=b"$"), LINE, "no line begins with '$'"),
        (LINE, LINE._replace(separator=b";", prefix=b"Q,"), "set `text.separator` = ';'"),
        (LINE._replace(width=6), LINE, "have 4 columns, expected 6: correct `text.columns`"),
        (LINE._replace(checksum=Checksum("xor8")), LINE, "no line has a valid checksum"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_the_report_names_the_key_that_fits(table: Any, device: Any, expected: str) -> None:
    assert expected in explain_bytes(sent(device), table)


def test_sync_bytes_without_a_regular_distance_are_named() -> None:
    plain = FRAME._replace(checksum=None)
    data = b"".join(b"\xaa\x55" + bytes(number % 7) for number in range(40))
    assert "sync bytes AA 55 have no regular distance" in explain_bytes(data, plain)


@pytest.mark.parametrize("form", [FRAME, BY_LENGTH, LINE], ids=["fixed", "length", "lines"])
def test_any_bytes_yield_a_text(form: Any) -> None:
    for data in (b"", b"\xaa", b"\xaa\x55" * 9, bytes(300), b"\n\n\n", b"Q\n" * 5, b"x" * 99):
        assert explain_bytes(data, form)
