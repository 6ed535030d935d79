"""Answers of the dialogue, and their consequences for later questions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from jointfit_daemon.config import LATER
from jointfit_daemon.tools.init._limbs import LIMBS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.tools.init._found import (
        CanSensor,
        Found,
        ImuDriver,
        KeyChoice,
        MocapDriver,
    )
    from jointfit_daemon.tools.init._limbs import Limb

Key = tuple[str, str]
"""Key of an answer: the key of the question, and its subject. The subject is a segment, a sensor, a
body part, or an empty text."""
Answers = dict[Key, Any]
"""Answers in the order in which they were given."""

_LAST_PORT = 65535


def limb_of(answers: Mapping[Key, Any]) -> Limb:
    """Return the limb that the user chose."""
    return LIMBS[answers["limb", ""]]


def sensors_of(answers: Mapping[Key, Any]) -> dict[str, str]:
    """Return the segment of every sensor, in the order of the rig."""
    limb = limb_of(answers)
    return {
        name: segment for segment in limb.segments for name in answers.get(("sensors", segment), ())
    }


def wiring_of(answers: Mapping[Key, Any], device: str) -> str:
    """Return the wiring of a device: ``can`` for a CAN bus or adapter, ``serial`` otherwise."""
    if device == LATER:
        return "serial"
    return "serial" if "/" in device and device not in answers["can_adapters", ""] else "can"


def is_connected(answers: Mapping[Key, Any], sensor: str) -> bool:
    """Return whether the connection of `sensor` is known."""
    return bool(answers.get(("device", sensor), LATER) != LATER)


def drivers_for(answers: Mapping[Key, Any], found: Found, sensor: str) -> tuple[ImuDriver, ...]:
    """Return the drivers that can read the device of `sensor`."""
    wiring = wiring_of(answers, answers["device", sensor])
    return tuple(driver for driver in found.imu_drivers if driver.wiring == wiring)


def driver_of(answers: Mapping[Key, Any], found: Found, sensor: str) -> ImuDriver:
    """Return the driver of `sensor`."""
    fitting = drivers_for(answers, found, sensor)
    named = {driver.name: driver for driver in fitting}
    recognized = found.recognized.get(str(answers.get(("device", sensor))))
    received = [each.driver for each in free_sensors(answers, found, sensor)]
    recognized = next((name for name in received if name in named), recognized)
    if ("driver", sensor) not in answers and recognized in named:
        return named[str(recognized)]

    # Without an answer, use the driver of the previous sensor: most rigs have sensors of one
    # family.
    sensors = list(sensors_of(answers))
    known = [answers.get(("driver", name)) for name in sensors[: sensors.index(sensor) + 1]]
    return next((named[name] for name in reversed(known) if name in named), fitting[0])


def free_sensors(answers: Mapping[Key, Any], found: Found, sensor: str) -> list[CanSensor]:
    """Return the recognized sensors on the bus of `sensor` whose identifiers are not in use."""
    bus = answers.get(("device", sensor))
    used = {number for each in ids_of_others(answers, sensor) for number in each}
    return [each for each in found.can_sensors.get(str(bus), ()) if used.isdisjoint(each.ids)]


def ids_of_others(answers: Mapping[Key, Any], sensor: str) -> list[tuple[int, ...]]:
    """Return the identifiers of the other sensors on the bus of `sensor`."""
    bus = answers.get(("device", sensor))
    return [
        ids
        for (key, other), ids in answers.items()
        if key == "ids" and other != sensor and ids != LATER
        and answers.get(("device", other)) == bus
    ]  # fmt: skip


def chosen_settings(answers: Mapping[Key, Any], sensor: str) -> dict[str, str]:
    """Return the answers to the questions on settings of `sensor`, by key."""
    settings = {subject: value for (key, subject), value in answers.items() if key == "setting"}
    names = ((subject.rpartition("."), value) for subject, value in settings.items())
    return {key: str(value) for (owner, _, key), value in names if owner == sensor}


def settings_asked(answers: Mapping[Key, Any], found: Found) -> tuple[str, ...]:
    """Return ``SENSOR.KEY`` for every required driver key whose values the dialogue lists."""
    return tuple(
        f"{name}.{choice.key}"
        for name in sensors_of(answers)
        if is_connected(answers, name)
        for choice in driver_of(answers, found, name).choices
    )


def choice_of(answers: Mapping[Key, Any], found: Found, subject: str) -> KeyChoice:
    """Return the driver key that the subject ``SENSOR.KEY`` names."""
    sensor, _, key = subject.rpartition(".")
    choices = driver_of(answers, found, sensor).choices
    return next(choice for choice in choices if choice.key == key)


def previous_answer(answers: Mapping[Key, Any], found: Found, question: str, subject: str) -> Any:
    """Return the answer to `question` for the last sensor before `subject` with the same driver.

    Without such an answer, return None.

    `subject` is a sensor, or ``SENSOR.KEY`` for a key of its driver.
    """
    sensors = list(sensors_of(answers))
    sensor, key = (subject, "") if subject in sensors else subject.rpartition(".")[::2]
    driver = driver_of(answers, found, sensor)
    for before in reversed(sensors[: sensors.index(sensor)]):
        given = answers.get((question, f"{before}.{key}" if key else before))
        if given is not None and driver_of(answers, found, before) == driver:
            return given
    return None


def mocap_driver_of(answers: Mapping[Key, Any], found: Found) -> MocapDriver:
    """Return the driver of the cameras."""
    announced = next(iter(found.server_drivers.values()), None)
    name = answers.get(("mocap_driver", ""), announced)
    known = found.mocap_drivers
    return next((driver for driver in known if driver.name == name), known[0])


def has_cameras(answers: Mapping[Key, Any]) -> bool:
    """Return whether the rig has cameras."""
    return limb_of(answers).is_planar or bool(answers["cameras", ""])


def marked_parts(answers: Mapping[Key, Any]) -> tuple[str, ...]:
    """Return the body parts that may carry markers, from proximal to distal."""
    if not has_cameras(answers):
        return ()
    limb = limb_of(answers)
    first = [limb.ends["proximal"]] if "proximal" in limb.ends else []
    return tuple(dict.fromkeys((*first, *limb.segments, *limb.optional_parts)))


def lengths_asked(answers: Mapping[Key, Any]) -> tuple[str, ...]:
    """Return the segments whose length the cameras cannot estimate."""
    limb = limb_of(answers)
    if limb.is_planar:
        return ()
    if not has_cameras(answers):
        return limb.segments
    return tuple(
        segment
        for segment in limb.segments
        if segment in limb.lengths_m
        or ((end := limb.end_of(segment)) is not None and not answers["markers", end])
    )


def split_address(text: str) -> tuple[str, int]:
    """Return host and port of ``HOST``, ``HOST:PORT`` or ``[IPv6]:PORT``; port 0 if missing.

    Raises
    ------
    ValueError
        The port is not a number from 1 to 65535.
    """
    if text.startswith("["):
        host, _, rest = text[1:].partition("]")
        port = rest.removeprefix(":")
    elif text.count(":") == 1:
        host, _, port = text.partition(":")
    else:
        host, port = text, ""
    if port and not (port.isascii() and port.isdigit() and 1 <= int(port) <= _LAST_PORT):
        raise ValueError(f"found the port {port!r}, expected a number from 1 to {_LAST_PORT}")
    return host, int(port or 0)
