"""Whether a line can carry what its sensors send: bits per second needed, and available.

Both are computed for the worst case, so that what is accepted works: all sensors on a bus at their
rate, frames with as many stuff bits as their length allows.
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
"""One byte on a serial line, 8N1."""
_BAUDS = (9600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 921_600, 2_000_000, 3_686_400)
"""Speeds that serial adapters and devices share."""
_CAN_RATES = (125_000, 250_000, 500_000, 800_000, 1_000_000)


def frame_bits(data_bytes: int, *, extended: bool) -> int:
    """Return the longest a CAN frame can be, bit, with stuff bits and the gap after it.

    A stuff bit follows every four bits after the first, of the data and of the 34 (11-bit
    identifier) or 54 (29-bit) bits from the start to the end of the checksum.
    """
    plain, stuffed = (64, 54) if extended else (44, 34)
    gap = 3
    return 8 * data_bytes + plain + (stuffed + 8 * data_bytes - 1) // 4 + gap


def slcan_bits(data_bytes: int, *, extended: bool) -> int:
    """Return the length of a frame as an SLCAN line: letter, identifier, length, data, CR."""
    return BYTE_BITS * (1 + (8 if extended else 3) + 1 + 2 * data_bytes + 1)


def serial_lines(sources: Sequence[Source]) -> Iterator[Fault]:
    """Check every sensor that has a serial line of its own."""
    for source in sources:
        needed = getattr(source.settings, "serial_bits_per_s", None)
        baud = getattr(source.settings, "baud", None)
        if needed is not None and baud is not None and needed > baud:
            slower = int(source.rate_hz * baud / needed)
            yield Fault(
                f"imu[{source.id}].baud",
                f"{source.rate_hz:g} Hz need {needed:.0f} bit/s, the line carries {baud}: "
                f"{_faster('baud', needed, _BAUDS)}{_slower(slower)}",
                baud,
            )


def can_buses(sources: Sequence[Source], buses: Mapping[str, CanBusSettings]) -> Iterator[Fault]:
    """Check every CAN bus with all sensors on it, and the serial line of an SLCAN adapter."""
    users: dict[str, list[Source]] = defaultdict(list)
    for source in sources:
        for name, bus in buses.items():
            if getattr(source.settings, "can", None) == bus:
                users[name].append(source)
    for name, members in users.items():
        bus = buses[name]
        sent = [(source.rate_hz, frame) for source in members for frame in _frames(source)]
        who = f"{', '.join(source.id for source in members)} need"
        on_bus = sum(hz * frame_bits(size, extended=ext) for hz, (size, ext) in sent)
        if on_bus > bus.bitrate:
            yield Fault(
                f"can.{name}.bitrate",
                f"{who} {on_bus:.0f} bit/s at most, the bus carries {bus.bitrate}: "
                f"{_faster('bitrate', on_bus, _CAN_RATES)}lower rate_hz, or use two buses",
                bus.bitrate,
            )
        on_line = sum(hz * slcan_bits(size, extended=ext) for hz, (size, ext) in sent)
        if bus.interface == "slcan" and bus.transport == "uart" and on_line > bus.baud:
            yield Fault(
                f"can.{name}.baud",
                f"{who} {on_line:.0f} bit/s as SLCAN, the line carries {bus.baud}: "
                f"{_faster('baud', on_line, _BAUDS)}lower rate_hz",
                bus.baud,
            )


def _frames(source: Source) -> tuple[tuple[int, bool], ...]:
    frames: tuple[tuple[int, bool], ...] = getattr(source.settings, "can_frames", ())
    return frames


def _faster(key: str, needed: float, speeds: Sequence[int]) -> str:
    enough = next((speed for speed in speeds if speed >= needed), None)
    return "" if enough is None else f"set {key} = {enough} or more here and on the device, or "


def _slower(rate_hz: int) -> str:
    return f"set rate_hz = {rate_hz} or less" if rate_hz else "no rate in whole Hz is slow enough"
