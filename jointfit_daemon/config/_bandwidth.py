"""Check that serial lines and CAN buses have the bit rate that their sensors need.

Worst case: all sensors of a bus send at their rate, with the largest number of stuff bits.
"""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

from jointfit_daemon.config._fault_messages import Fault

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from jointfit_daemon.config._rig import Source
    from jointfit_daemon.driver import CanBusSettings

BYTE_BITS = 10
"""Bits of one byte on a serial line (8N1)."""
_BAUDS = (9600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 921_600, 2_000_000, 3_686_400)
"""Common speeds of serial adapters and devices, baud."""
_CAN_RATES = (125_000, 250_000, 500_000, 800_000, 1_000_000)
"""Common bit rates of CAN buses, bit/s."""


def frame_bits(data_bytes: int, *, extended: bool) -> int:
    """Return the largest length of a CAN frame, bit, with stuff bits and interframe space.

    With s = 34 (11-bit identifier) or 54 (29-bit) bits from the start to the end of the checksum
    and d data bytes, at most (s + 8 d − 1) / 4 stuff bits occur (ISO 11898-1).
    """
    plain, stuffed = (64, 54) if extended else (44, 34)
    gap = 3
    return 8 * data_bytes + plain + (stuffed + 8 * data_bytes - 1) // 4 + gap


def slcan_bits(data_bytes: int, *, extended: bool) -> int:
    """Return the length of an SLCAN line, bit: letter, identifier, length, data, CR."""
    return BYTE_BITS * (1 + (8 if extended else 3) + 1 + 2 * data_bytes + 1)


def check_serial_lines(sources: Sequence[Source]) -> Iterator[Fault]:
    """Check every sensor on a separate serial line."""
    for source in sources:
        needed = getattr(source.settings, "serial_bits_per_s", None)
        baud = getattr(source.settings, "baud", None)
        if needed is not None and baud is not None and needed > baud:
            rate_hz = int(source.rate_hz * baud / needed)
            slower = f"set rate_hz = {rate_hz} or less"
            yield Fault(
                f"imu[{source.id}].baud",
                f"{source.rate_hz:g} Hz need {needed:.0f} bit/s, the line carries {baud}: "
                f"{_faster('baud', needed, _BAUDS)}"
                f"{slower if rate_hz else 'no rate in whole Hz is slow enough'}",
                baud,
            )


def check_can_buses(
    sources: Sequence[Source], buses: Mapping[str, CanBusSettings]
) -> Iterator[Fault]:
    """Check every CAN bus with all its sensors, and the serial line of an SLCAN adapter."""
    users: dict[str, list[Source]] = defaultdict(list)
    for source in sources:
        for name, bus in buses.items():
            if getattr(source.settings, "can", None) == bus:
                users[name].append(source)

    for name, members in users.items():
        bus = buses[name]
        sent = [
            (source.rate_hz, frame)
            for source in members
            for frame in getattr(source.settings, "can_frames", ())
        ]
        needing = f"{', '.join(source.id for source in members)} need"
        on_bus = sum(hz * frame_bits(size, extended=ext) for hz, (size, ext) in sent)
        if on_bus > bus.bitrate:
            yield Fault(
                f"can.{name}.bitrate",
                f"{needing} {on_bus:.0f} bit/s at most, the bus carries {bus.bitrate}: "
                f"{_faster('bitrate', on_bus, _CAN_RATES)}lower rate_hz, or use two buses",
                bus.bitrate,
            )

        on_line = sum(hz * slcan_bits(size, extended=ext) for hz, (size, ext) in sent)
        if bus.interface == "slcan" and bus.transport == "uart" and on_line > bus.baud:
            yield Fault(
                f"can.{name}.baud",
                f"{needing} {on_line:.0f} bit/s as SLCAN, the line carries {bus.baud}: "
                f"{_faster('baud', on_line, _BAUDS)}lower rate_hz",
                bus.baud,
            )


def _faster(key: str, needed: float, speeds: Sequence[int]) -> str:
    enough = next((speed for speed in speeds if speed >= needed), None)
    return "" if enough is None else f"set {key} = {enough} or more here and on the device, or "
