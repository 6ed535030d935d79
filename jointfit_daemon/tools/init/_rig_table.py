"""Conversion of answers to the tables of rig.toml."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from jointfit_daemon.config import LATER
from jointfit_daemon.tools.init._answers import (
    Key,
    driver_of,
    has_cameras,
    lengths_asked,
    limb_of,
    marked_parts,
    mocap_driver_of,
    previous_answer,
    sensors_of,
    split_address,
    wiring_of,
)
from jointfit_daemon.tools.init._proposals import layout

if TYPE_CHECKING:
    from jointfit_daemon.tools.init._found import Found, Wiring

Given = Mapping[Key, Any]

AXES_CHECK_HZ = 10
"""Rate of the topic that the dashboard needs for its check of the sensor axes, Hz."""


def rig_table(answers: Given, found: Found) -> dict[str, Any]:
    """Return the tables of a rig.toml, in the order in which the file contains them.

    Parameters
    ----------
    answers
        An answer to every question that applies.
    found
        Drivers of the devices.
    """
    table: dict[str, Any] = {
        "rig": {"name": answers["name", ""], "output_rate_hz": answers["output_rate_hz", ""]},
        "chain": _chain(answers),
    }

    if not limb_of(answers).is_planar:
        devices = dict.fromkeys(answers["device", name] for name in sensors_of(answers))
        on_can = [device for device in devices if wiring_of(answers, device) == "can"]
        buses = {device: f"can{at}" for at, device in enumerate(on_can)}
        table["imu"] = [_imu(answers, found, buses, name) for name in sensors_of(answers)]
        if buses:
            table["can"] = {name: _bus(answers, device) for device, name in buses.items()}

    if has_cameras(answers):
        table["mocap"] = _mocap(answers, found)
    table["calibration"] = {"store": answers["subject", ""]}
    table["mqtt"] = _mqtt(answers)
    return table


def _chain(answers: Given) -> dict[str, Any]:
    limb = limb_of(answers)
    table: dict[str, Any] = {}
    if limb.joints:
        table["joints"] = list(limb.joints)
    table["segments"] = list(limb.segments)
    if limb.has_side:
        table["side"] = answers["side", ""]
    table |= {end: part for end, part in limb.ends.items() if answers.get(("markers", part))}
    if limb.is_planar:
        table["motion"] = "planar"

    lengths = {name: answers["length_m", name] for name in lengths_asked(answers)}
    if known := {name: length for name, length in lengths.items() if length is not None}:
        table["lengths_m"] = known
    if limb.branches:
        table["joint"] = [dict(joint) for joint in limb.branches]
        for joint in table["joint"]:  # a distal body part without markers is omitted
            child = joint["child"]
            if child not in limb.segments and not answers.get(("markers", child)):
                del joint["child"]
    return table


def _bus(answers: Given, device: str) -> dict[str, Any]:
    if device in answers["can_adapters", ""]:
        bitrate = answers["bitrate", device]
        return {"interface": "slcan", "channel": device, "bitrate": bitrate}
    return {"interface": "socketcan", "channel": device}


def _imu(answers: Given, found: Found, buses: Mapping[str, str], name: str) -> dict[str, Any]:
    driver, device = driver_of(answers, found, name), answers["device", name]
    table: dict[str, Any] = {
        "id": name,
        "segment": sensors_of(answers)[name],
        "driver": driver.name,
    }

    table |= {"port": device} if driver.wiring == "serial" else {"can": buses[device]}
    if driver.baud is not None and device != LATER:
        table["baud"] = answers["baud", name]
    if driver.ids and answers["ids", name] == LATER:
        table["ids"] = LATER
    elif driver.ids:
        table["ids"] = dict(zip(driver.ids, answers["ids", name], strict=True))
        if any(number > _STANDARD_MAX for number in answers["ids", name]):
            table["extended_ids"] = True

    for choice in driver.choices:
        given = answers.get(("setting", f"{name}.{choice.key}"))
        given = given or previous_answer(answers, found, "setting", f"{name}.{choice.key}")
        by_text = {str(value): value for value in choice.values}
        table[choice.key] = by_text.get(str(given), choice.values[0])
    if driver.needs_layout:
        file = answers.get(("layout", name)) or layout(answers, found, name)
        at = list(sensors_of(answers)).index(name)
        stand_in = _layout_stand_in(driver.wiring, at)
        table |= found.layouts.get(str(file), stand_in)
    return table | {"rate_hz": answers["sensor_rate_hz", ""]}


def _layout_stand_in(wiring: Wiring, at: int) -> dict[str, Any]:
    """Return a placeholder for the checks while the layout of sensor number `at` is unknown."""
    if wiring == "serial":
        return {"text": {}, "fields": {"quaternion": {"column": 1}}}
    quaternion = {"offset": 0, "type": "i16", "divisor": 32767}
    return {"ids": {"quaternion": 0x300 + at}, "fields": {"quaternion": quaternion}}


_STANDARD_MAX = 0x7FF
"""Largest 11-bit CAN identifier."""


def _mocap(answers: Given, found: Found) -> dict[str, Any]:
    driver = mocap_driver_of(answers, found)
    host, port = split_address(answers["server", ""])
    table: dict[str, Any] = {"driver": driver.name, "server": host}
    if port and driver.port is not None:
        table[driver.port_key] = port
    if driver.up_axis != "auto":  # with "auto", the driver reads the axis from the stream
        table["up_axis"] = answers["up_axis", ""]
    if answers.get(("plate", "")) is not None:
        table["plate"] = answers["plate", ""]
    named = {part: answers["markers", part] for part in marked_parts(answers)}
    markers = {
        part: LATER if names == LATER else [*names] for part, names in named.items() if names
    }
    return table | {"markers": markers}


def _mqtt(answers: Given) -> dict[str, Any]:
    host, port = split_address(answers["broker", ""])
    table: dict[str, Any] = {"host": host} | ({"port": port} if port else {})
    if answers["username", ""] is not None:
        table["username"] = answers["username", ""]
        table["password_file"] = answers["password_file", ""]
    if not limb_of(answers).is_planar:
        table["sensors_hz"] = AXES_CHECK_HZ

    # These keys have no answers if the broker runs on this machine.
    encryption = answers.get(("encryption", ""))
    if encryption == "none":
        table["insecure"] = True
    elif encryption is not None:
        table["tls"] = {"ca": answers["ca", ""]} if encryption == "own-ca" else {}
    return table
