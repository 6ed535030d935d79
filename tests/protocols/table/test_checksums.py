"""Checksums that parameters describe return the published check values of "123456789"."""

from __future__ import annotations

import pytest

from jointfit_protocols.table import Checksum, compile_checksum

TEXT = b"123456789"


@pytest.mark.parametrize(
    ("checksum", "value"),
    [
        (Checksum("crc8"), 0xF4),  # CRC-8/SMBUS
        (Checksum("crc8", polynomial=0x31, reflected=True), 0xA1),  # CRC-8/MAXIM-DOW
        (Checksum("crc8", polynomial=0x1D, init=0xFF, xor_out=0xFF), 0x4B),  # CRC-8/SAE-J1850
        (Checksum("crc16", init=0xFFFF), 0x29B1),  # CRC-16/IBM-3740
        (Checksum("crc16"), 0x31C3),  # CRC-16/XMODEM
        (Checksum("crc16", reflected=True), 0x2189),  # CRC-16/KERMIT
        (Checksum("crc16", polynomial=0x8005, init=0xFFFF, reflected=True), 0x4B37),  # MODBUS
        (Checksum("crc16", polynomial=0x8005), 0xFEE8),  # CRC-16/UMTS
        (
            Checksum("crc32", init=0xFFFFFFFF, reflected=True, xor_out=0xFFFFFFFF),
            0xCBF43926,  # CRC-32/ISO-HDLC
        ),
        (Checksum("crc32", init=0xFFFFFFFF), 0x0376E6E7),  # CRC-32/MPEG-2
        (Checksum("fletcher16", modulus=255), 0x1EDE),
        (Checksum("xor8"), 0x31),
        (Checksum("sum8"), 0xDD),
        (Checksum("sum16"), 0x01DD),
    ],
    ids=lambda value: value.kind if isinstance(value, Checksum) else hex(value),
)
def test_check_values(checksum: Checksum, value: int) -> None:
    assert compile_checksum(checksum)(TEXT) == value


def test_fletcher_of_bytes_in_turn() -> None:
    """The checksum equals the loop in manuals: a = a + byte, b = b + a."""
    for modulus in (255, 256):
        a, b = 3, 5
        for byte in TEXT:
            a = (a + byte) % modulus
            b = (b + a) % modulus
        checksum = Checksum("fletcher16", init=5 << 8 | 3, modulus=modulus)
        assert compile_checksum(checksum)(TEXT) == b << 8 | a


def test_a_sum_with_its_checksum_is_zero_with_the_documented_parameters() -> None:
    total = compile_checksum(Checksum("sum8", init=0xFF, xor_out=0xFF))(TEXT)
    assert (sum(TEXT) + total) % 256 == 0
