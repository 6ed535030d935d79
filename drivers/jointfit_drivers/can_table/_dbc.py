"""Positions of signals in CAN frames, from a DBC file. `cantools` (extra ``dbc``) reads the file.

Invariant: only the functions of this module import that package.
"""

from __future__ import annotations

from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from jointfit_daemon.name_lists import list_names
from jointfit_drivers.table_samples import FieldFaultError
from jointfit_protocols.table import Kind, TableField

if TYPE_CHECKING:
    from collections.abc import Sequence

PACKAGE_MISSING = (
    "DBC files need the package cantools: pip install 'jointfitd[dbc]', or give `offset` and "
    "`type` of the fields"
)
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


def read_signals(path: str, names: Sequence[str]) -> list[DbcSignal]:
    """Return signals of a DBC file. Their names are SIGNAL or MESSAGE.SIGNAL.

    Raises
    ------
    FieldFaultError
        The package or the file is missing, the file is malformed, or its signals overlap. Or a
        signal is missing, ambiguous or multiplexed.
    """
    if find_spec("cantools") is None:
        raise FieldFaultError("signals", PACKAGE_MISSING)
    file = Path(path)
    try:
        stamp = file.stat().st_mtime_ns
    except OSError as error:
        text = f"{path}: {error.strerror}: correct the name in `dbc`"
        raise FieldFaultError("signals", text) from None
    messages = _messages(path, stamp)
    if isinstance(messages, str):
        raise FieldFaultError("signals", f"{path}: {messages}")
    return [_signal(name, messages, file.name) for name in names]


@lru_cache(maxsize=8)
def _messages(path: str, stamp: int) -> list[Any] | str:
    """Return the messages of a file, or the reason why it cannot be used."""
    del stamp  # a changed file is read again
    import cantools  # noqa: PLC0415 - an extra

    try:
        database = cantools.database.load_file(path, database_format="dbc", strict=True)
    except (cantools.Error, UnicodeDecodeError, OSError) as error:
        return f"cannot be read ({error}): correct the file"
    return list(getattr(database, "messages", []))


def _signal(name: str, messages: Sequence[Any], file: str) -> DbcSignal:
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
    if signal.is_multiplexer or signal.multiplexer_ids is not None:
        text = f"{name!r} is multiplexed in {message.name}: such signals cannot be used"
        raise FieldFaultError("signals", text)
    kind: Kind = "f" if signal.is_float else "i" if signal.is_signed else "u"
    little = signal.byte_order == "little_endian"
    # A big-endian signal starts at its most significant bit.
    bit = signal.start % 8 if little else 7 - signal.start % 8
    place = TableField(
        signal.start // 8,
        kind,
        signal.length,
        "little" if little else "big",
        bit,
        float(signal.scale),
        float(signal.offset),
    )
    unit = _UNITS.get((signal.unit or "").strip())
    return DbcSignal((message.frame_id, bool(message.is_extended_frame)), place, unit)
