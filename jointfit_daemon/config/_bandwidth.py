"""Check that serial lines and CAN buses are fast enough for their sensors.

The check assumes the worst case: all sensors of a bus send at their configured rate, and every CAN
frame has the largest number of stuff bits.
"""

from __future__ import annotations

from collections import defaultdict
from itertools import product
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from pydantic import BaseModel

from jointfit_daemon.config._fault_messages import Fault
from jointfit_daemon.nearest_name import nearest_key

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from pydantic.fields import FieldInfo

    from jointfit_daemon.config._rig import Source
    from jointfit_daemon.driver import CanBusSettings

BYTE_BITS = 10
"""Bits of one byte on a serial line (8N1)."""
_BAUDS = (9600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 921_600, 2_000_000, 3_686_400)
"""Common speeds of serial adapters and devices, baud."""
_CAN_RATES = (125_000, 250_000, 500_000, 800_000, 1_000_000)
"""Common bit rates of CAN buses, bit/s."""


def frame_bits(data_bytes: int, *, extended: bool) -> int:
    """Return the largest length of a CAN frame, bit, including stuff bits and interframe space.

    A frame has s bits from its start to the end of its checksum, without data: s = 34 with an
    11-bit identifier, s = 54 with a 29-bit identifier. With d data bytes, at most (s + 8 d − 1) / 4
    stuff bits occur, rounded down (ISO 11898-1).
    """
    plain, stuffed = (64, 54) if extended else (44, 34)
    gap = 3
    return 8 * data_bytes + plain + (stuffed + 8 * data_bytes - 1) // 4 + gap


def slcan_bits(data_bytes: int, *, extended: bool) -> int:
    """Return the length of an SLCAN line, bit: letter, identifier, length, data, CR."""
    return BYTE_BITS * (1 + (8 if extended else 3) + 1 + 2 * data_bytes + 1)


_ADAPTERS: dict[str, tuple[str, int, Callable[[int, bool], int]]] = {
    "serial": ("baudrate", 115_200, lambda size, _: 11 + size),
    "seeedstudio": ("baudrate", 2_000_000, lambda size, ext: (7 if ext else 5) + size),
    "robotell": ("ttyBaudrate", 115_200, lambda _size, _: 21),
}
"""Serial CAN adapters of python-can. Values: key of the speed, default speed in baud, and function
that returns the number of bytes of a CAN frame on the serial line."""


def _adapter_line(bus: CanBusSettings) -> tuple[str, int, Callable[[int, bool], int]] | None:
    """Return the serial line of a CAN adapter: key of its speed, speed in baud, bits per CAN frame.

    Return None if the bus does not use a serial line.
    """
    if bus.interface == "slcan" and bus.transport == "uart":
        return "baud", bus.baud, lambda size, ext: slcan_bits(size, extended=ext)
    if bus.interface not in _ADAPTERS:
        return None
    key, default, length = _ADAPTERS[bus.interface]
    speed = (bus.model_extra or {}).get(key, default)
    return None if type(speed) is not int else (key, speed, lambda *a: BYTE_BITS * length(*a))


def least_load(settings: Any, unknown: Iterable[str]) -> Any:
    """Return a sensor's settings with the smallest possible load; None if no load is known.

    A faulty value, such as a misspelled value of the key `orientation`, may stand for any valid
    value. The result therefore contains the valid value with the smallest load. If even this load
    is too large, the line is too slow in any case.

    Parameters
    ----------
    settings
        Table of the sensor, in which faulty keys are None.
    unknown
        Keys that do not exist. Each is probably a misspelling of the key that it resembles.
    """
    fields = type(settings).model_fields
    faulty = {
        name
        for name, field in fields.items()
        if getattr(settings, name) is None and (field.is_required() or field.default is not None)
    }
    faulty |= {near for name in unknown if (near := nearest_key(name, fields)) is not None}

    possible: list[tuple[float, int, Any]] = []
    choices = {name: _choices(fields[name]) for name in sorted(faulty)}
    for values in product(*filter(None, choices.values())):
        candidate = settings.model_copy()
        for name in faulty:  # reading a key that is absent raises AttributeError
            candidate.__dict__.pop(name, None)
        candidate.__dict__.update(
            zip((name for name, known in choices.items() if known), values, strict=True)
        )
        try:
            possible.append((_load(candidate), len(possible), candidate))
        except Exception:  # noqa: BLE001 - AttributeError, or what a plug-in raises on missing keys
            return None
    return min(possible)[2]


def _choices(field: FieldInfo) -> list[Any]:
    """Return all values of a Boolean or a choice, or the default of an inner table.

    The list is empty for other fields. The default represents all values of an inner table, such as
    CAN identifiers, because they do not change the load.
    """
    annotation: Any = field.annotation
    if annotation is bool:
        return [False, True]
    if get_origin(annotation) is Literal:
        return list(get_args(annotation))
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [] if field.is_required() else [field.get_default(call_default_factory=True)]
    return []


def _load(settings: Any) -> float:
    """Return the load of a sensor, bit/s, on the serial line or the bus that it uses.

    Raises
    ------
    AttributeError
        A key that changes the load is absent.
    """
    for name in {"rate_hz", "baud", "can"} & type(settings).model_fields.keys():
        getattr(settings, name)
    on_bus = sum(frame_bits(size, extended=ext) for size, ext in settings.can_frames)
    return float(settings.serial_bits_per_s or 0.0) + float(settings.rate_hz * on_bus)


def check_serial_lines(sources: Sequence[Source]) -> Iterator[Fault]:
    """Check every sensor that has its own serial line."""
    for source in sources:
        needed = getattr(source.settings, "serial_bits_per_s", None)
        baud = getattr(source.settings, "baud", None)
        if needed is not None and baud is not None and needed > baud:
            rate_hz = int(source.rate_hz * baud / needed)
            remedies = [_faster("baud", needed, _BAUDS)]
            remedies += [f"set rate_hz = {rate_hz} or less"] if rate_hz else []
            yield Fault(
                f"imu[{source.id}].baud",
                f"{source.rate_hz:g} Hz need {needed:.0f} bit/s, the line carries {baud}: "
                f"{_either(remedies) or 'no rate in whole Hz is slow enough'}",
                baud,
            )


def check_can_buses(
    sources: Sequence[Source], buses: Mapping[str, CanBusSettings]
) -> Iterator[Fault]:
    """Check every CAN bus with all its sensors, and the serial line of a serial CAN adapter."""
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
        verb = "needs" if len(members) == 1 else "need"
        needing = f"{', '.join(source.id for source in members)} {verb}"
        on_bus = sum(hz * frame_bits(size, extended=ext) for hz, (size, ext) in sent)
        if on_bus > bus.bitrate:
            faster = _faster("bitrate", on_bus, _CAN_RATES)
            yield Fault(
                f"can.{name}.bitrate",
                f"{needing} up to {on_bus:.0f} bit/s, but the bus carries only {bus.bitrate}: "
                f"{_either([faster, 'lower rate_hz', 'use two buses'])}",
                bus.bitrate,
            )

        if (line := _adapter_line(bus)) is None:
            continue
        key, speed, bits = line
        on_line = sum(hz * bits(size, ext) for hz, (size, ext) in sent)
        if on_line > speed:
            faster = _faster(key, on_line, _BAUDS)
            yield Fault(
                f"can.{name}.{key}",
                f"{needing} {on_line:.0f} bit/s on the adapter's serial line, which carries "
                f"{speed}: {_either([faster, 'lower rate_hz'])}",
                speed,
            )


def _faster(key: str, needed: float, speeds: Sequence[int]) -> str:
    enough = next((speed for speed in speeds if speed >= needed), None)
    return "" if enough is None else f"set {key} = {enough} or more here and on the device"


def _either(remedies: Iterable[str]) -> str:
    return ", or ".join(filter(None, remedies))
