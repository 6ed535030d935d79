"""The questions of the dialogue, in the order in which they are asked.

Invariant: questions are frozen data. Whatever the earlier answers are, every default and every
stand-in is a valid answer.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from jointfit_daemon.config import is_this_host
from jointfit_daemon.tools.init import _proposals
from jointfit_daemon.tools.init._answers import (
    Key,
    choice_of,
    driver_of,
    drivers_for,
    has_cameras,
    is_connected,
    lengths_asked,
    limb_of,
    marked_parts,
    mocap_driver_of,
    sensors_of,
    settings_asked,
    split_address,
)
from jointfit_daemon.tools.init._found import Found, FoundDevice
from jointfit_daemon.tools.init._limbs import LIMBS

if TYPE_CHECKING:
    from jointfit_daemon.tools.init._parsing import Kind

Finder = Literal["movement", "traffic", "identifiers", "stream"]
"""Search that the command ``find`` starts. The search finds a sensor by its movement, a driver by
the received data, the identifiers on a CAN bus, or the names in a motion-capture stream."""

Given = Mapping[Key, Any]
Propose = Callable[[Given, Found, str], Any]
ONCE = ("",)


def _nothing(_answers: Given, _found: Found, _subject: str) -> Any:
    return None


@dataclass(frozen=True, slots=True)
class Question:
    """One question, which is asked once or once for each subject."""

    key: str
    """Key in answer files."""
    kind: Kind
    text: str
    """Text of the question, with a placeholder for the subject."""
    help: str
    group: str = ""
    """Name of a group of adjacent questions. All questions of the group are asked for one subject
    before the next subject."""
    subjects: Callable[[Given, Found], tuple[str, ...]] = lambda _answers, _found: ONCE
    """Function that returns the subjects; it returns none if earlier answers exclude the question.
    """
    default: Propose = _nothing
    """Function that returns the proposed answer, or None if there is no proposal."""
    stand_in: Propose = _nothing
    """Function that returns a valid answer for the checks of earlier answers, used if there is no
    default."""
    choices: Callable[[Given, Found, str], tuple[FoundDevice, ...]] = lambda *_: ()
    """Function that returns the entries of the displayed list."""
    optional: bool = False
    """Whether the answer may be empty."""
    postponable: bool = False
    """Whether the user may answer ``later``. This word is also the proposal if there is no default.
    """
    finder: Finder | None = None
    explain: Propose = _nothing
    """Function that returns the help text for one subject, or None if `help` applies."""
    is_of_keys: bool = False
    """Whether each subject is a key of a sensor in the group, such as ``S1.mode`` for ``S1``."""


def _if(condition: Callable[[Given], bool]) -> Callable[[Given, Found], tuple[str, ...]]:
    return lambda answers, _found: ONCE if condition(answers) else ()


def _sensors(answers: Given, _found: Found) -> tuple[str, ...]:
    return tuple(sensors_of(answers))


def _has_sensors(answers: Given) -> bool:
    return not limb_of(answers).is_planar


def _is_remote(answers: Given) -> bool:
    return not is_this_host(split_address(answers["broker", ""])[0])


def _always(value: Any) -> Propose:
    return lambda _answers, _found, _subject: value


def _limbs(_answers: Given, _found: Found, _subject: str) -> tuple[FoundDevice, ...]:
    return tuple(FoundDevice(name, limb.text) for name, limb in LIMBS.items())


def _list(*entries: tuple[str, str]) -> Callable[..., tuple[FoundDevice, ...]]:
    listed = tuple(FoundDevice(*entry) for entry in entries)
    return lambda _answers, _found, _subject: listed


def _identifiers(answers: Given, found: Found, sensor: str) -> tuple[FoundDevice, ...]:
    """Return the names of a sensor's CAN identifiers, each with an example value."""
    names, numbers = driver_of(answers, found, sensor).ids, _proposals.unused_ids
    pairs = zip(names, numbers(answers, found, sensor), strict=True)
    return tuple(FoundDevice(name, f"{number:#05x}") for name, number in pairs)


_IDS_HELP = (
    "Identifiers of the messages of this sensor. 'find' receives on a CAN interface and proposes"
    " the identifiers of its sensors. Answer 'later' if they are not known yet."
)

QUESTIONS: tuple[Question, ...] = (
    Question(
        "name",
        "text",
        "Name of the rig",
        "It becomes part of every MQTT topic. Letters of any script are allowed, but not the"
        " characters / + #.",
        default=_always("bench-1"),
    ),
    Question(
        "limb",
        "choice",
        "Limb",
        "Segments and joints of the rig. For other limbs, see the documentation of rig.toml.",
        default=_always("knee"),
        choices=_limbs,
    ),
    Question(
        "side",
        "choice",
        "Side of the body",
        "It determines the sign of adduction and rotation.",
        subjects=_if(lambda answers: limb_of(answers).has_side),
        default=_always("right"),
        choices=_list(("right", ""), ("left", "")),
    ),
    Question(
        "subject",
        "text",
        "Name of the subject's calibrations",
        "Name of the folder for the calibrations, from letters, digits, and the characters . _ -",
        default=_always("subject-1"),
    ),
    Question(
        "output_rate_hz",
        "number",
        "Poses per second (Hz)",
        "Rate at which joint angles are published.",
        default=_always(100),
    ),
    Question(
        "sensor_rate_hz",
        "number",
        "Samples per second of each sensor (Hz)",
        "Rate to which the sensors are set. Choose at least the rate of the poses.",
        subjects=_if(_has_sensors),
        default=_proposals.sensor_rate,
    ),
    Question(
        "sensors",
        "names",
        "Sensors on the {subject}",
        "Names of the sensors, separated by commas. Two sensors per segment reduce the error that"
        " soft tissue causes; one sensor is enough. The names become MQTT topics.",
        subjects=lambda answers, _: limb_of(answers).segments if _has_sensors(answers) else (),
        default=_proposals.sensors,
    ),
    Question(
        "can_adapters",
        "names",
        "Serial ports that are CAN adapters (SLCAN)",
        "Paths, separated by commas; empty if there are none. A CAN interface of the kernel, such"
        " as can0, needs no entry here.",
        subjects=_if(_has_sensors),
        optional=True,
    ),
    Question(
        "bitrate",
        "number",
        "Bit rate of the CAN bus at {subject} (bit/s)",
        "It is the same for all devices on the bus; Xsens sensors leave the factory with 250000.",
        subjects=lambda answers, _: answers["can_adapters", ""] if _has_sensors(answers) else (),
        default=_always(1_000_000),
    ),
    Question(
        "device",
        "device",
        "Connection of the sensor {subject}",
        "A number of the list, the path of a serial port, or a CAN interface. 'find' detects the"
        " sensor by its movement: it opens the free ports and buses of the list. If the sensor is"
        " not connected yet, answer 'later': rig.toml then contains this word.",
        group="sensor",
        postponable=True,
        subjects=_sensors,
        default=_proposals.device,
        stand_in=_proposals.unused_port,
        choices=_proposals.devices,
        finder="movement",
    ),
    Question(
        "driver",
        "choice",
        "Driver of the sensor {subject}",
        "Several installed drivers can read this connection. 'find' receives on the serial port or"
        " CAN interface, without sending, and proposes the driver that decodes the data.",
        group="sensor",
        subjects=lambda answers, found: tuple(
            name
            for name in sensors_of(answers)
            if is_connected(answers, name) and len(drivers_for(answers, found, name)) > 1
        ),
        default=lambda answers, found, sensor: driver_of(answers, found, sensor).name,
        choices=lambda answers, found, sensor: tuple(
            FoundDevice(driver.name, driver.text) for driver in drivers_for(answers, found, sensor)
        ),
        finder="traffic",
    ),
    Question(
        "baud",
        "number",
        "Speed of the sensor {subject} (baud)",
        "Speed to which the device is set; Xsens sensors leave the factory with 115200.",
        group="sensor",
        subjects=lambda answers, found: tuple(
            name
            for name in sensors_of(answers)
            if is_connected(answers, name) and driver_of(answers, found, name).baud is not None
        ),
        default=_proposals.baud,
    ),
    Question(
        "setting",
        "choice",
        "Setting {subject}",
        "A property of the device that its data do not show.",
        group="sensor",
        is_of_keys=True,
        subjects=settings_asked,
        default=_proposals.setting,
        stand_in=lambda answers, found, subject: str(choice_of(answers, found, subject).values[0]),
        choices=lambda answers, found, subject: tuple(
            FoundDevice(str(value), choice_of(answers, found, subject).meaning(value))
            for value in choice_of(answers, found, subject).values
        ),
        explain=lambda answers, found, subject: choice_of(answers, found, subject).help,
    ),
    Question(
        "ids",
        "ids",
        "CAN identifiers of the sensor {subject}",
        _IDS_HELP,
        group="sensor",
        postponable=True,
        subjects=lambda answers, found: tuple(
            name
            for name in sensors_of(answers)
            if is_connected(answers, name) and driver_of(answers, found, name).ids
        ),
        default=_proposals.ids,
        stand_in=_proposals.unused_ids,
        choices=_identifiers,
        finder="identifiers",
        explain=lambda answers, found, sensor: (
            f"{', '.join(driver_of(answers, found, sensor).ids)}, such as "
            f"{' '.join(each.text for each in _identifiers(answers, found, sensor))}. {_IDS_HELP}"
        ),
    ),
    Question(
        "layout",
        "text",
        "File with the layout of the data of the sensor {subject}",
        "TOML file with the keys of the [[imu]] table that describe the frames or lines of the"
        " sensor: `frame` or `text`, `ids`, `dbc` and `fields`. The key `dbc` names a DBC file. The"
        " pages on serial-table and can-table in the documentation have examples. A rig.toml with"
        " such a table is accepted, too.",
        subjects=lambda answers, found: tuple(
            name
            for name in sensors_of(answers)
            if is_connected(answers, name) and driver_of(answers, found, name).needs_layout
        ),
        default=_proposals.layout,
        stand_in=_always(""),
    ),
    Question(
        "cameras",
        "yes_no",
        "Is there an optical motion-capture system?",
        "It measures joint centres and soft-tissue artefact in the calibration. Without it, a"
        " static pose calibrates the sensors.",
        subjects=_if(_has_sensors),
        default=lambda _answers, found, _subject: bool(found.servers),
    ),
    Question(
        "mocap_driver",
        "choice",
        "Motion-capture system",
        "Driver of the system.",
        subjects=lambda answers, found: (
            ONCE if has_cameras(answers) and len(found.mocap_drivers) > 1 else ()
        ),
        default=lambda answers, found, _: mocap_driver_of(answers, found).name,
        choices=lambda _answers, found, _subject: tuple(
            FoundDevice(driver.name, driver.text) for driver in found.mocap_drivers
        ),
    ),
    Question(
        "server",
        "address",
        "Computer of the motion-capture system",
        "Name or address of the computer that runs the camera software, with :PORT if its port is"
        " not the usual one. Answer 'later' if it is not known yet.",
        postponable=True,
        subjects=_if(has_cameras),
        default=lambda _answers, found, _: next((s.address for s in found.servers), None),
        stand_in=_always("192.168.1.10"),
        choices=lambda _answers, found, _subject: found.servers,
    ),
    Question(
        "markers",
        "names",
        "Markers on the {subject}",
        "Names in the stream, separated by commas: at least three that are not on one line."
        " 'find' reads the names from the stream. Answer 'later' if they are not known yet. Body"
        " parts that are not segments may have no markers.",
        postponable=True,
        subjects=lambda answers, _: marked_parts(answers),
        default=_proposals.markers,
        stand_in=_proposals.unused_markers,
        finder="stream",
    ),
    Question(
        "plate",
        "text",
        "Rigid body of the plate for the align phase",
        "Name, in the stream, of the plate to which all sensors are fastened in the align phase,"
        " which is needed once per laboratory. Answer"
        " 'later' if it is not known yet.",
        postponable=True,
        subjects=_if(lambda answers: _has_sensors(answers) and has_cameras(answers)),
        default=_proposals.plate,
        optional=True,
    ),
    Question(
        "up_axis",
        "choice",
        "Vertical axis of the stream",
        "Motive's default is y.",
        subjects=lambda answers, found: (
            ONCE
            if has_cameras(answers) and mocap_driver_of(answers, found).up_axis != "auto"
            else ()
        ),
        default=lambda answers, found, _: mocap_driver_of(answers, found).up_axis,
        choices=_list(("x", ""), ("y", ""), ("z", "")),
    ),
    Question(
        "length_m",
        "number",
        "Length of the {subject} (m)",
        "Distance from joint to joint. Without it, the positions of the joints below the segment"
        " are unknown. Joint angles do not depend on it.",
        subjects=lambda answers, _: lengths_asked(answers),
        default=lambda answers, _, segment: limb_of(answers).lengths_m.get(segment),
        optional=True,
    ),
    Question(
        "broker",
        "address",
        "MQTT broker",
        "Name or address of the computer of the broker, with :PORT if the port is not the usual"
        " one.",
        default=_always("127.0.0.1"),
    ),
    Question(
        "encryption",
        "choice",
        "Encryption of the connection to the broker",
        "Without encryption, any computer on the network path can read and send all messages.",
        subjects=_if(_is_remote),
        default=_always("tls"),
        choices=_list(
            ("tls", "TLS, certificate of a public authority"),
            ("own-ca", "TLS, certificate of an authority of your own"),
            ("none", "no encryption"),
        ),
    ),
    Question(
        "ca",
        "text",
        "File with the certificate of the authority",
        "PEM file, relative to the folder of the rig.",
        subjects=_if(lambda answers: _is_remote(answers) and answers["encryption", ""] == "own-ca"),
        default=_always("ca.pem"),
    ),
    Question(
        "username",
        "text",
        "User name for the broker",
        "Empty if the broker requires none.",
        optional=True,
    ),
    Question(
        "password_file",
        "text",
        "File for the password",
        "The password is in a separate file that only its owner can read, never in rig.toml.",
        subjects=_if(lambda answers: answers["username", ""] is not None),
        default=_always("mqtt-password"),
    ),
)
"""All questions, in the order in which they are asked."""
