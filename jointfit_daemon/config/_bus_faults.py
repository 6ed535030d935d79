"""Replacement of wrong keys in a ``[can.NAME]`` table, so that other checks find further faults."""

from __future__ import annotations

from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from jointfit_daemon.config._readable import readable_part
from jointfit_daemon.driver import (
    SERIAL_ADAPTERS,
    CanBusError,
    CanBusSettings,
    driver_names,
    find_driver,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

_CLOSE = 0.8
"""Smallest similarity, 0 to 1, between a misspelled interface and the known interface that replaces
it in further checks."""


def unusable_keys(table: Mapping[str, Any], in_use: Iterable[str]) -> dict[str, str]:
    """Return the faults of a bus by key; empty if at least one CAN driver accepts the bus.

    Only drivers know which interfaces can be opened. The drivers `in_use` check the bus first,
    then the other drivers. The first driver that accepts the bus ends the search, so later drivers
    are not imported. If no driver accepts the bus, the faults of the first driver are returned.
    """
    bus = readable_part({"channel": "can0", **table}, CanBusSettings, [])
    defaults = dict(CanBusSettings(channel="can0"))
    absent = {key: value for key, value in defaults.items() if getattr(bus, key) is None}
    bus = bus.model_copy(update=absent)
    reason: dict[str, str] = {}
    for name in dict.fromkeys([*in_use, *driver_names()]):
        try:
            model = find_driver(name).Settings
            if "can" not in model.model_fields:
                continue
            faults = _refusal(model, bus)
        except Exception:  # noqa: BLE001, S112 - a broken plug-in is a fault of its users only
            continue
        if not faults:
            return {}
        reason = reason or faults
    return reason


def _refusal(model: Any, bus: CanBusSettings) -> dict[str, str]:
    try:
        model.model_validate({"can": bus})
    except ValidationError as error:
        for detail in error.errors():
            if detail["loc"] == ("can",):
                cause = detail.get("ctx", {}).get("error")
                text = detail["msg"].removeprefix("Value error, ")
                return cause.faults if isinstance(cause, CanBusError) else {"interface": text}
    return {}


def likely_interface(interface: str) -> str:
    """Return the interface that replaces an unknown interface.

    If no known interface is similar, the result is `virtual`, which accepts all other keys.
    """
    return next(iter(get_close_matches(interface, ("socketcan", "slcan"), 1, _CLOSE)), "virtual")


def complete_bus(partial: CanBusSettings, name: str) -> CanBusSettings:
    """Return a bus in which valid values replace the wrong keys, which are None in `partial`.

    The valid values cause no further fault. `name` must be unique: buses with equal settings count
    as one bus, whose sensors must have different identifiers.
    """
    channel = f"/dev/{name}" if partial.interface in SERIAL_ADAPTERS else name
    valid = dict(CanBusSettings(interface="virtual", channel=channel))
    wrong = [name for name, value in partial if value is None and name in valid]
    return partial.model_copy(update={name: valid[name] for name in wrong})
