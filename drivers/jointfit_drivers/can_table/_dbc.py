"""Positions of signals in CAN frames, from a DBC file. `cantools` (extra ``dbc``) reads the file.

A DBC file describes the frames and signals of a CAN bus. A multiplexer is a signal whose value
selects the other signals of the same frame.

Invariant: only the functions of this module import `cantools`.
"""

from __future__ import annotations

import re
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from jointfit_daemon.name_lists import list_names
from jointfit_drivers.table_samples import FieldFaultError
from jointfit_protocols.table import FieldReader, Kind, Multiplexer, TableField

if TYPE_CHECKING:
    from collections.abc import Sequence

PACKAGE_MISSING = (
    "DBC files need the package cantools: pip install 'jointfitd[dbc]', or give `offset` and "
    "`type` of the fields"
)
_MOST_VALUES = 1024
"""Largest number of values of a multiplexer in one range. `cantools` needs a time proportional to
the square of this number."""
_DIGITS = 9
"""Largest number of digits of a value in a range."""
_MULTIPLEXED = re.compile(r"SG_MUL_VAL_\s+\d+\s+(?P<signal>\w+)\s+\w+\s+(?P<ranges>[\d\s,-]+);")
_RANGE = re.compile(r"(\d+)\s*-\s*(\d+)")
_NAMED = 12
"""Largest number of names in one error message."""
_UNITS = {
    "rad/s": "rad/s", "deg/s": "deg/s", "dps": "deg/s", "°/s": "deg/s",
    "m/s2": "m/s2", "m/s^2": "m/s2", "m/s²": "m/s2", "g": "g", "mg": "mg",
    "s": "s", "ms": "ms", "us": "us", "µs": "us", "ns": "ns",
}  # fmt: skip
"""Units of rig.toml by their spellings in DBC files."""


class DbcSignal(NamedTuple):
    """One signal of a DBC file."""

    key: tuple[int, bool]
    """Identifier of the signal's frame, and whether the identifier has 29 bits."""
    place: TableField
    """Position in the frame, with scale and offset as in the file."""
    unit: str | None
    """Unit of the signal; None if rig.toml has no such unit."""
    multiplexer: Multiplexer | None
    """Values of the multiplexer with which the frame contains the signal; None if every frame
    contains it."""


def read_signals(path: str, names: Sequence[str]) -> list[DbcSignal]:
    """Return the signals `names` of a DBC file. A name is SIGNAL or MESSAGE.SIGNAL.

    Raises
    ------
    FieldFaultError
        The package `cantools`, the file or a signal is missing, the file is malformed, its signals
        overlap, or a name is ambiguous.
    """
    if find_spec("cantools") is None:
        raise FieldFaultError("signals", PACKAGE_MISSING)
    file = Path(path)
    try:
        stamp = file.stat().st_mtime_ns
    except OSError as error:
        text = f"{path}: {error.strerror}: correct the name in `dbc`"
        raise FieldFaultError("signals", text) from None
    return [_signal(name, path, stamp) for name in names]


@lru_cache(maxsize=8)
def _messages(path: str, stamp: int) -> list[Any] | str:
    """Return the messages of a file, or the reason why the file cannot be used."""
    del stamp  # part of the cache key, so that a changed file is read again
    import cantools  # noqa: PLC0415 - an extra

    try:
        if fault := _range_fault(Path(path).read_bytes().decode("latin-1")):
            return fault
        database = cantools.database.load_file(path, database_format="dbc", strict=True)
    except (cantools.Error, UnicodeDecodeError, OSError) as error:
        return f"cannot be read ({error}): correct the file"
    return list(getattr(database, "messages", []))


def _range_fault(text: str) -> str | None:
    """Return why the values of a multiplexer cannot be used; None if they can be used."""
    for line in _MULTIPLEXED.finditer(text):
        for first, last in _RANGE.findall(line["ranges"]):
            if len(last) > _DIGITS or int(last) - int(first[:_DIGITS]) >= _MOST_VALUES:
                return (
                    f"SG_MUL_VAL_ of {line['signal']} has the range {first}-{last}, expected at "
                    f"most {_MOST_VALUES} values: list the values that the device sends"
                )
    return None


@lru_cache(maxsize=128)
def _signal(name: str, path: str, stamp: int) -> DbcSignal:
    messages = _messages(path, stamp)
    if isinstance(messages, str):
        raise FieldFaultError("signals", f"{path}: {messages}")
    file = Path(path).name
    message_name, _, signal_name = name.rpartition(".")
    found = [
        (message, signal)
        for message in messages
        for signal in message.signals
        if signal.name == signal_name and message_name in {"", message.name}
    ]
    if not found:
        known = sorted({signal.name for message in messages for signal in message.signals})
        text = f"{file} has no signal {name!r}; it has {list_names(known, _NAMED)}"
        raise FieldFaultError("signals", text)
    if len(found) > 1:
        choices = ", ".join(f"{message.name}.{signal_name}" for message, _ in found)
        text = f"{name!r} is a signal of several messages: name one of {choices}"
        raise FieldFaultError("signals", text)

    message, signal = found[0]
    if signal.is_signed and signal.length == 1:
        text = (
            f"{message.name}.{signal_name} is signed and has 1 bit, so it can only be 0 or -1: "
            "declare it as unsigned (+) in the DBC file"
        )
        raise FieldFaultError("signals", text)
    unit = _UNITS.get((signal.unit or "").strip())
    key = (message.frame_id, bool(message.is_extended_frame))
    return DbcSignal(key, _place(signal), unit, _multiplexer(message, signal))


def _place(signal: Any) -> TableField:
    kind: Kind = "f" if signal.is_float else "i" if signal.is_signed else "u"
    little = signal.byte_order == "little_endian"
    # A big-endian signal starts at its most significant bit.
    bit = signal.start % 8 if little else 7 - signal.start % 8
    return TableField(
        signal.start // 8,
        kind,
        signal.length,
        "little" if little else "big",
        bit,
        float(signal.scale),
        float(signal.offset),
    )


def _multiplexer(message: Any, signal: Any) -> Multiplexer | None:
    """Return the values of the multiplexer with which a frame contains a signal.

    A multiplexer may itself be multiplexed (extended multiplexing). The result then combines the
    bits of all these multiplexers.

    Raises
    ------
    FieldFaultError
        The multiplexer has too few bits for every one of the values.
    """
    if signal.multiplexer_ids is None:
        return None
    selecting = message.get_signal_by_name(signal.multiplexer_signal)
    place = _place(selecting)._replace(kind="u")
    reader = FieldReader([place])

    def at_its_bits(value: int) -> int:
        data = bytearray(reader.size)
        reader.write(data, [value])
        return int.from_bytes(data, "little")

    mask = at_its_bits(place.modulus - 1)
    possible = [value for value in signal.multiplexer_ids if 0 <= value < place.modulus]
    if not possible:
        text = (
            f"{message.name}.{signal.name} is present at {selecting.name} = "
            f"{signal.multiplexer_ids[0]}, but {selecting.name} has {place.bits} bits: correct the "
            "DBC file"
        )
        raise FieldFaultError("signals", text)
    inner = Multiplexer(mask, frozenset(map(at_its_bits, possible)))
    outer = _multiplexer(message, selecting)
    return inner & outer if outer else inner
