"""Default answers, derived from earlier answers and from found devices."""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import chain, count
from typing import TYPE_CHECKING, Any

from jointfit_daemon.config import LATER
from jointfit_daemon.tools.init._answers import (
    Key,
    chosen_settings,
    driver_of,
    free_sensors,
    ids_of_others,
    is_connected,
    limb_of,
    marked_parts,
    previous_answer,
    sensors_of,
)
from jointfit_daemon.tools.init._found import FoundDevice

if TYPE_CHECKING:
    from jointfit_daemon.tools.init._found import Found

Given = Mapping[Key, Any]

_USUAL_BAUDS = (115_200, 230_400, 460_800, 921_600, 2_000_000)
"""Usual serial speeds, baud, in the order in which they are proposed."""
_BITS_PER_SAMPLE = 600
"""Number of bits per sample: an upper estimate for a message with orientation and raw readings."""
_MARKERS = 4
"""Number of proposed markers: three, and a fourth because one marker may be hidden."""
_LEAST_MARKERS = 3
_ID_STEP = 0x100
"""Difference between the identifiers of two sensors in placeholder answers."""


def sensor_rate(answers: Given, _found: Found, _subject: str) -> Any:
    """Return the rate of the poses, Hz, if it is a usual rate of sensors; otherwise 100 Hz."""
    rate = answers["output_rate_hz", ""]
    return rate if rate in (50, 100, 200, 400) else 100


def sensors(answers: Given, _found: Found, segment: str) -> tuple[str, ...]:
    """Return a sensor name for each usual sensor position on `segment`."""
    used = {*sensors_of(answers)}
    names = []
    for place in limb_of(answers).places[segment]:
        plain = f"{segment.replace('_', '-')}-{place}"
        numbered = (f"{plain}-{k}" for k in count(2))
        names.append(next(name for name in chain((plain,), numbered) if name not in used))
        used.add(names[-1])
    return tuple(names)


def devices(answers: Given, found: Found, _sensor: str) -> tuple[FoundDevice, ...]:
    """Return all buses and CAN adapters, and the serial ports that no other sensor uses."""
    used = {value for (key, _), value in answers.items() if key == "device"}
    adapters = answers["can_adapters", ""]
    ports = [port for port in found.ports if port.address in adapters or port.address not in used]
    known = {port.address for port in found.ports}
    typed = [FoundDevice(path, "CAN adapter") for path in adapters if path not in known]
    return (*ports, *typed, *found.interfaces)


def device(answers: Given, found: Found, sensor: str) -> str | None:
    """Return the only listed device if only one sensor has no device; otherwise return None."""
    listed = devices(answers, found, sensor)
    waiting = [name for name in sensors_of(answers) if not is_connected(answers, name)]
    return listed[0].address if len(listed) == 1 and len(waiting) == 1 else None


def unused_port(answers: Given, found: Found, _sensor: str) -> str:
    """Return a port path that no sensor uses."""
    used = {value for (key, _), value in answers.items() if key == "device"}
    used |= {*answers["can_adapters", ""], *found.addresses}
    return next(f"/dev/sensor{k}" for k in count() if f"/dev/sensor{k}" not in used)


def baud(answers: Given, found: Found, sensor: str) -> int:
    """Return the speed at which the device answered.

    If no device answered, return the driver's default if it suffices for the sensor rate, or else
    the first higher usual speed that suffices, or else the highest usual speed.
    """
    known = found.bauds.get(answers["device", sensor])
    if known is not None:
        return known
    usual = driver_of(answers, found, sensor).baud or _USUAL_BAUDS[0]
    needed = answers["sensor_rate_hz", ""] * _BITS_PER_SAMPLE
    fitting = [speed for speed in (usual, *_USUAL_BAUDS) if speed >= max(needed, usual)]
    return fitting[0] if fitting else _USUAL_BAUDS[-1]


def setting(answers: Given, found: Found, subject: str) -> str | None:
    """Return the value that the first matching free sensor on the bus has.

    If there is none, return the answer for the last sensor with the same driver, or else None.
    """
    sensor, _, key = subject.rpartition(".")
    name, given = driver_of(answers, found, sensor).name, chosen_settings(answers, sensor)
    for received in free_sensors(answers, found, sensor):
        if received.agrees(name, given) and key in received.settings:
            return str(received.settings[key])
    value = previous_answer(answers, found, "setting", subject)
    return None if value is None else str(value)


def layout(answers: Given, found: Found, sensor: str) -> str | None:
    """Return the layout file of the last sensor with the same driver, or None.

    The result is None if there is no such sensor, and for a sensor on a CAN bus: sensors on a CAN
    bus have different identifiers, so they cannot share a layout file.
    """
    if driver_of(answers, found, sensor).wiring == "can":
        return None
    value = previous_answer(answers, found, "layout", sensor)
    return None if value is None else str(value)


def ids(answers: Given, found: Found, sensor: str) -> tuple[int, ...] | None:
    """Return the identifiers of the first free sensor in the received frames, or None.

    A sensor is free if no other sensor of the rig uses its identifiers. It must also match the
    chosen driver and settings.
    """
    name, given = driver_of(answers, found, sensor).name, chosen_settings(answers, sensor)
    free = free_sensors(answers, found, sensor)
    return next((each.ids for each in free if each.agrees(name, given)), None)


def unused_ids(answers: Given, found: Found, sensor: str) -> tuple[int, ...]:
    """Return identifiers that no other sensor on the bus uses."""
    used = {number for each in ids_of_others(answers, sensor) for number in each}
    driver, given = driver_of(answers, found, sensor), chosen_settings(answers, sensor)
    for possible in driver.possible:
        if possible.agrees(driver.name, given) and used.isdisjoint(possible.ids):
            return possible.ids

    first = tuple(driver.ids.values())
    for step in count():
        numbers = tuple(number + step * _ID_STEP for number in first)
        block = {number & ~0xFF for number in numbers}
        if not any(number & ~0xFF in block for number in used):
            return numbers
    raise AssertionError


def _markers_in_use(answers: Given) -> set[str]:
    return {
        name
        for (key, _), names in answers.items()
        if key == "markers" and names != LATER
        for name in names
    }


def markers(answers: Given, found: Found, part: str) -> tuple[str, ...] | None:
    """Return the streamed marker names that match `part`; without a stream, return usual names.

    Marker names that differ only in their last digits form a group. A group matches a body part if
    the common text equals the name of the part or one of the usual prefixes of the part, and if the
    group has at least three markers (planar limb: one). If no group matches, the
    result is empty for an optional part, and None for a required part.
    """
    if not found.markers:
        return unused_markers(answers, found, part)
    used = _markers_in_use(answers)
    groups: dict[str, list[str]] = {}
    for name in found.markers:
        if name not in used:
            groups.setdefault(_stem(name), []).append(name)

    for prefix in (part, *limb_of(answers).prefixes[part]):
        names = groups.get(_stem(prefix), ())
        if len(names) >= _LEAST_MARKERS or (names and limb_of(answers).is_planar):
            return tuple(names)
    return () if is_optional(answers, part) else None


def _stem(name: str) -> str:
    return re.sub(r"[\s_.:-]*\d*$", "", name).casefold().replace("_", "").replace(" ", "")


def unused_markers(answers: Given, _found: Found, part: str) -> tuple[str, ...]:
    """Return the usual marker names on `part`; the numbers skip names that are in use."""
    used = _markers_in_use(answers)
    prefix = limb_of(answers).prefixes[part][0]
    numbered = (f"{prefix}{k}" for k in count(1))
    free = (name for name in numbered if name not in used)
    return tuple(next(free) for _ in range(_MARKERS))


def is_optional(answers: Given, part: str) -> bool:
    """Return whether the markers of `part` may be omitted."""
    limb = limb_of(answers)
    return not limb.is_planar and part in limb.optional_parts and part in marked_parts(answers)


def plate(_answers: Given, found: Found, _subject: str) -> str | None:
    """Return the rigid body whose name contains ``plate``, or None if the stream has no such body.

    Without a stream, return ``Plate``.
    """
    if not found.bodies and not found.markers:
        return "Plate"
    return next((body for body in found.bodies if "plate" in body.casefold()), None)
