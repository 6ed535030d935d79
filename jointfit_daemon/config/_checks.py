"""Checks of names, and of values in several tables of rig.toml.

Invariant: a check returns all faults of its tables, except the faults that another fault causes. A
check of one name returns at most one fault.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from typing import TYPE_CHECKING, Any, get_args

from pydantic import BaseModel

from jointfit_daemon.config._branched_limb import check_branches
from jointfit_daemon.config._fault_messages import Fault
from jointfit_daemon.config._rig import MOCAP
from jointfit_daemon.config._tables import JOINTS_HELP
from jointfit_daemon.limb_model import PatentReading
from jointfit_daemon.nearest_name import nearest_name

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from jointfit_daemon.config._rig import Rig, Source
    from jointfit_daemon.config._tables import (
        CalibrationTable,
        ChainTable,
        MqttSettings,
    )
    from jointfit_daemon.driver import CanBusSettings, MocapSettings

_FORBIDDEN = "+#/"
"""Characters that have a special meaning in MQTT topics."""
_FOLDER = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_LONGEST_M = 3.0
"""Upper limit of a segment length, m; larger numbers are probably millimetres."""
_FARTHEST_M = 100.0
"""Upper limit of a coordinate of the fixed origin, m; larger numbers are probably millimetres."""
_STANDARD_MAX = 0x7FF
"""Largest 11-bit CAN identifier."""
_LEAST_PLANAR = 2
"""Smallest number of markers that defines an orientation in a plane."""
_LEAST_MARKERS = 3
"""Smallest number of markers that defines an orientation."""


def check_control_characters(value: object, key: str = "") -> Iterator[Fault]:
    """Check that no text contains NUL, which is invalid in names of files, ports and topics."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from check_control_characters(name, f"key {name!r}")
            yield from check_control_characters(inner, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list):
        for at, inner in enumerate(value):
            place = imu_name(inner, at + 1) if key == "imu" and isinstance(inner, dict) else at
            yield from check_control_characters(inner, f"{key}[{place}]")
    elif isinstance(value, str) and "\0" in value:
        yield Fault(key, "must not contain a NUL character", value)


def without_control_characters(value: Any) -> Any:
    """Return a copy of `value` without NUL, so that the other checks can run."""
    if isinstance(value, dict):
        return {
            without_control_characters(name): without_control_characters(inner)
            for name, inner in value.items()
        }
    if isinstance(value, list):
        return [without_control_characters(inner) for inner in value]
    return value.replace("\0", "") if isinstance(value, str) else value


def imu_name(imu: Mapping[str, Any], number: int) -> str:
    """Return the name of an ``[[imu]]`` table for messages: its id, or else its `number`."""
    name = imu.get("id")
    return name.replace("\0", "") if isinstance(name, str) and name else f"#{number}"


def check_topic_name(key: str, name: str) -> list[Fault]:
    """Check a name that is used as one level of an MQTT topic."""
    if not name.strip():
        return [Fault(key, "must not be empty: it becomes an MQTT topic", name)]
    if bad := [letter for letter in _FORBIDDEN if letter in name]:
        return [Fault(key, f"must not contain {' '.join(bad)}: it becomes an MQTT topic", name)]
    if name.startswith("$") or not name.isprintable() or name != name.strip():
        what = "must not begin with $, contain control characters, or begin or end with a blank"
        return [Fault(key, f"{what}: it becomes an MQTT topic", name)]
    return []


def check_topic_base(key: str, base: str) -> list[Fault]:
    """Check the base topic, which may contain slashes, but no empty level."""
    return [
        Fault(key, fault.expected, base)
        for level in base.split("/")
        for fault in check_topic_name(key, level)
    ][:1]


def check_folder_name(key: str, name: str) -> list[Fault]:
    """Check a name that is used as a folder of the calibration store."""
    if _FOLDER.fullmatch(name):
        return []
    allowed = "letters, digits, . _ and -, beginning with a letter or digit"
    return [Fault(key, f"must be the plain name of one folder: {allowed}", name)]


def check_chain(table: ChainTable) -> Iterator[Fault]:
    """Check the names of the limb, its branches, lengths and angle conventions.

    The number of joints is checked as well. Keys of `table` that had faults are None.
    """
    names_of = {"joints": table.joints, "segments": table.segments}
    if table.joint != ():
        names_of["joint"] = tuple(joint.name for joint in table.joint or ())
        yield from check_branches(table)
    elif table.joints == ():
        yield Fault("chain.joints", f"missing; {JOINTS_HELP}")
    for key, names in names_of.items():
        for name in names or ():
            yield from check_topic_name(f"chain.{key}", name)
        if key != "joint":
            yield from _find_repetitions(f"chain.{key}", names or ())

    found = [len(names) for names in (table.joints, table.segments) if names]
    if len(found) == 2 and found[0] != found[1] + 1:  # noqa: PLR2004 - both could be read
        yield Fault(
            "chain.joints",
            f"expected {len(table.segments) + 1} joints, one more than segments",
            list(table.joints),
        )

    # Check adjacent body parts and configured lengths.
    for key in ("proximal", "distal"):
        if (name := getattr(table, key)) is not None:
            yield from check_topic_name(f"chain.{key}", name)
            if name in (table.segments or ()):
                yield Fault(f"chain.{key}", "is already a segment", name)
    yield from _check_values_by_name(table)


def _check_values_by_name(table: ChainTable) -> Iterator[Fault]:
    """Check the lengths of segments, the fixed origin, and the angle conventions of joints."""
    lengths: Any = table.lengths_m or {}
    for name, length in lengths.items():
        if table.segments:
            yield from check_known_name(f"chain.lengths_m.{name}", name, table.segments, "segment")
        if length is not None and not 0 < length < _LONGEST_M:
            yield Fault(
                f"chain.lengths_m.{name}",
                f"expected a length in metres, below {_LONGEST_M:g}",
                length,
            )
    origin: Any = table.origin_m or ()
    if any(value is not None and not abs(value) < _FARTHEST_M for value in origin):
        text = f"expected a position in metres, closer than {_FARTHEST_M:g}"
        yield Fault("chain.origin_m", text, list(origin))
    joints, segments = table.joints or (), table.segments or ()
    complete = len(joints) == len(segments) + 1
    inner = joints[1:-1] if complete else joints  # only joints between two segments have angles
    if table.joint:
        inner = tuple(joint.name for joint in table.joint if joint.child in segments)
    for name in table.angles or {}:
        if inner:
            key = f"chain.angles.{name}"
            yield from check_known_name(key, name, inner, "joint between two segments")


def check_durations(table: CalibrationTable) -> Iterator[Fault]:
    """Check that ``functional_s`` is at least ``functional_min_s``; faulty keys are None."""
    longest, shortest = table.functional_s, table.functional_min_s
    if None not in (longest, shortest) and longest < shortest:
        text = f"is shorter than functional_min_s = {shortest:g}: increase it, or decrease that key"
        yield Fault("calibration.functional_s", text, longest)


def check_procedure(
    calibration: CalibrationTable | None, chain: ChainTable | None
) -> Iterator[Fault]:
    """Check that the regression method and the segment axes fit ``procedure = "patent"``.

    Keys of the tables that had faults are None.
    """
    if calibration is None or calibration.procedure != "patent":
        return
    if calibration.method not in {None, *get_args(PatentReading)}:
        regressions = " or ".join(f'"{name}"' for name in get_args(PatentReading))
        text = f'expected {regressions} with procedure = "patent": the patent is a regression'
        yield Fault("calibration.method", text, calibration.method)
    if chain is not None and chain.axes == "anatomical":
        text = (
            'expected "static" with calibration.procedure = "patent": the patent defines every '
            "segment as unrotated in the static pose"
        )
        yield Fault("chain.axes", text, chain.axes)


def check_known_name(
    key: str, name: str, known: Collection[str], what: str, taken: Collection[str] = ()
) -> list[Fault]:
    """Check that `name` is one of `known`; `what` is the kind of these names, such as "segment".

    The fault suggests the most similar name that is not one of `taken`.
    """
    if name in known:
        return []
    choices = ", ".join(known) or "none"
    near = nearest_name(name, [other for other in known if other not in taken])
    return [Fault(key, f"unknown {what}; known: {choices}", name, near)]


def _find_repetitions(key: str, names: Iterable[str]) -> Iterator[Fault]:
    for name, times in Counter(names).items():
        if times > 1:
            yield Fault(key, f"named {times} times, expected once", name)


def check_sensors(imus: Sequence[Mapping[str, Any]], table: ChainTable | None) -> Iterator[Fault]:
    """Check the ids and segments of all readable ``[[imu]]`` tables."""
    ids = [imu["id"] for imu in imus if isinstance(imu.get("id"), str)]
    yield from _find_repetitions("imu.id", ids)
    for name in dict.fromkeys(ids):
        yield from check_topic_name(f"imu[{name}].id", name)
        if name == MOCAP:
            yield Fault(f"imu[{name}].id", "is reserved for the optical source", name)
    if table is None or not table.segments:
        return

    worn = [imu["segment"] for imu in imus if isinstance(imu.get("segment"), str)]
    for at, imu in enumerate(imus, 1):
        if isinstance(imu.get("segment"), str):
            key = f"imu[{imu_name(imu, at)}].segment"
            yield from check_known_name(key, imu["segment"], table.segments, "segment")
    if any(not isinstance(imu.get("segment"), str) for imu in imus):
        return  # this fault is reported already, and the sensor may be on any segment
    for segment in table.segments:
        if segment not in worn and table.motion != "planar":
            yield Fault("imu", f"segment {segment!r} has no sensor, expected at least one")


def body_parts_of(table: ChainTable) -> list[str]:
    """Return the segments and the body parts that have markers only.

    Keys of `table` that had faults are None.
    """
    ends = [joint.child for joint in table.joint or ()]
    parts = [table.proximal, *(table.segments or ()), *ends, table.distal]
    return list(dict.fromkeys(part for part in parts if part))


def check_markers(settings: MocapSettings, table: ChainTable | None) -> Iterator[Fault]:
    """Check the markers and rigid bodies of ``[mocap]``; keys that had faults are None."""
    # A value that is not a table is already reported.
    given: dict[str, dict[str, Any]] = {
        kind: value if isinstance(value := getattr(settings, kind), dict) else {}
        for kind in ("markers", "rigid_body")
    }
    taken = {part for parts in given.values() for part in parts}
    for kind, bodies in given.items():
        for part in bodies:
            if table is not None and table.segments:
                parts = body_parts_of(table)
                yield from check_known_name(f"mocap.{kind}.{part}", part, parts, "segment", taken)

    readable = {part: names for part, names in given["markers"].items() if names is not None}
    for part, names in readable.items():
        key = f"mocap.markers.{part}"
        yield from _find_repetitions(key, names)
        planar = table is not None and table.motion == "planar"
        if not planar and len(set(names)) < _LEAST_MARKERS:
            yield Fault(key, "expected at least three different markers", list(names))
        if part in given["rigid_body"]:
            yield Fault(
                f"mocap.rigid_body.{part}",
                "has markers already: remove the markers, or this rigid body",
            )

    # A marker belongs to one body part.
    owners: dict[str, str] = {}
    for part, names in readable.items():
        for name in dict.fromkeys(names):
            if (owner := owners.setdefault(name, part)) != part:
                yield Fault(f"mocap.markers.{part}", f"is a marker of {owner!r} already", name)


def check_planar(table: ChainTable, cameras: MocapSettings | None, imus: object) -> Iterator[Fault]:
    """Check that a planar rig has no sensors, and enough markers on every segment and end.

    Keys that had faults are None.
    """
    if table.motion != "planar":
        return
    if cameras is None:
        yield Fault("chain.motion", "planar motion needs cameras: add [mocap]", "planar")
        return
    if imus:
        text = "expected none with chain.motion = planar, which needs cameras only: remove one key"
        yield Fault("imu", text)
    if table.joint:
        yield Fault("chain.joint", "planar motion has no branches: use joints, or remove motion")
    if table.model is not None:
        yield Fault("chain.model", "is for spatial motion: remove it, or chain.motion")
    if cameras.rigid_body:
        text = "planar motion is followed by single markers: name them under mocap.markers"
        yield Fault("mocap.rigid_body", text, dict(cameras.rigid_body))

    yield from _check_planar_markers(table, cameras)


def _check_planar_markers(table: ChainTable, cameras: MocapSettings) -> Iterator[Fault]:
    markers, segments = cameras.markers or {}, table.segments or ()
    for part in segments:
        if len(set(markers.get(part) or ())) < _LEAST_PLANAR:
            found = list(markers.get(part) or ())
            text = "expected at least two different markers; only ends (proximal, distal) need one"
            yield Fault(f"mocap.markers.{part}", text, found)
    ends = [part for part in (table.proximal, table.distal) if part is not None]
    for part in ends:
        if not markers.get(part):
            yield Fault(f"mocap.markers.{part}", "expected at least one marker")
    if not ends and len(segments) == 1:
        text = "planar motion needs two parts: name an end (proximal or distal) or a segment"
        yield Fault("chain.segments", text, list(segments))


def check_center_methods(
    table: CalibrationTable, chain: ChainTable | None, mocap: MocapSettings | None
) -> Iterator[Fault]:
    """Check that joints with a configured estimator exist and that the cameras can measure them.

    Keys of `table` and `chain` that had faults are None; `mocap` is None without cameras.
    """
    chosen: Any = table.joint_center_methods or {}
    explicit = {f"calibration.joint_center_methods.{joint}": joint for joint in chosen}
    if mocap is None:
        keys = [*explicit] if table.center_method == "sphere" else ["calibration.center_method"]
        for key in keys:
            yield Fault(key, "joint centers need cameras: add [mocap], or remove this key")
        return
    joints = chain is not None and (chain.joints or chain.joint)
    if chain is None or not joints or not chain.segments or mocap.markers is None:
        return

    marked = {*(mocap.markers or ()), *(mocap.rigid_body or ())}
    sides = _sides_of_joints(chain)
    for key, joint in explicit.items():
        if faults := check_known_name(key, joint, [*sides], "joint", chosen):
            yield from faults
            continue
        for part, addition in sides[joint]:
            if part is None:
                text = f"needs markers on both sides of the joint: add {addition} and its markers"
                yield Fault(key, text, chosen[joint] or joint)
        for part, _ in sides[joint]:
            if part is not None and part not in marked:
                text = f"needs markers on both sides of the joint: add mocap.markers.{part}"
                yield Fault(key, text, chosen[joint] or joint)


def _sides_of_joints(chain: ChainTable) -> dict[str, list[tuple[str | None, str]]]:
    """Return the two body parts of each joint (None if missing), each with the key that sets it."""
    if chain.joint:
        return {
            joint.name: [(joint.parent, ""), (joint.child, f"chain.joint[{joint.name}].child")]
            for joint in chain.joint
        }
    parts = [chain.proximal, *chain.segments, chain.distal]
    named = [(part, "chain.distal" if at else "chain.proximal") for at, part in enumerate(parts)]
    return {joint: named[at : at + 2] for at, joint in enumerate(chain.joints)}


def check_ports(sources: Sequence[Source], buses: Mapping[str, CanBusSettings]) -> Iterator[Fault]:
    """Check that no serial port is used twice."""
    users = [
        (f"imu[{source.id}].port", getattr(source.settings, "port", None)) for source in sources
    ]
    users += [
        (f"can.{name}.channel", bus.channel)
        for name, bus in buses.items()
        if bus.interface == "slcan"
    ]

    taken: dict[str, str] = {}
    for key, port in users:
        if isinstance(port, str):  # A link and its target are the same port.
            owner = taken.setdefault(os.path.realpath(port), key)
            if owner != key:
                yield Fault(key, f"is the port of {owner.rpartition('.')[0]} already", port)


def check_can_ids(sources: Sequence[Source]) -> Iterator[Fault]:
    """Check that every message id on a bus is used by one sensor only.

    An 11-bit and a 29-bit identifier of the same number are different identifiers.
    """
    owners: dict[tuple[str, int, bool], tuple[str, str]] = {}
    for source in sources:
        settings = source.settings
        bus = getattr(settings, "can", None)
        if bus is None:
            continue

        ids = getattr(settings, "ids", None)
        for message, number in _numbers(ids):
            extended = getattr(settings, "extended_ids", False) or number > _STANDARD_MAX
            derived = " derived from its other ids" if getattr(ids, message, 0) is None else ""
            user = f"{source.id} ({message}{derived})"
            sensor, owner = owners.setdefault((repr(bus), number, extended), (source.id, user))
            if sensor != source.id:
                text = f"id {number:#x} on this bus belongs to {owner}; expected a unique id"
                if derived:
                    text = f"{text}. It is{derived}: set it to an unused one"
                yield Fault(f"imu[{source.id}].ids.{message}", text)


def missing_files(mqtt: MqttSettings) -> list[str]:
    """Return a warning for every configured file that does not exist.

    A missing file is not a fault, because it may be created later or by another user.
    """
    tls = mqtt.tls
    files = {"password_file": mqtt.password_file, "request_key_file": mqtt.request_key_file}
    if tls is not None:
        files |= {"tls.ca": tls.ca, "tls.cert": tls.cert, "tls.key": tls.key}
    return [
        f"mqtt.{key} = {path!r}: no such file; create it before the daemon starts, or correct the "
        "name"
        for key, path in files.items()
        if path is not None and not os.path.exists(path)  # noqa: PTH110 - NUL returns False
    ]


def drifting_imus(sources: Sequence[Source]) -> frozenset[str]:
    """Return the IMUs whose heading the gateway computes without magnetometer, so it drifts."""
    return frozenset(_on_gateway(sources)[True])


def _on_gateway(sources: Sequence[Source]) -> dict[bool, list[str]]:
    """Return the IMUs whose heading the gateway computes, grouped by whether the heading drifts."""
    drifts: dict[bool, list[str]] = {True: [], False: []}
    for source in sources:
        if getattr(source.settings, "orientation", None) == "gateway":
            drifts[not getattr(source.settings, "magnetometer", False)].append(source.id)
    return drifts


def heading_warning(sources: Sequence[Source]) -> str | None:
    """Return a warning if the gateway uses the magnetometer of only some IMUs; else None.

    The configuration is permitted. Devices that compute their own orientation are not considered,
    since their use of a magnetometer is unknown.
    """
    drifts = _on_gateway(sources)
    if not drifts[True] or not drifts[False]:
        return None
    drifting = ", ".join(drifts[True])
    return (
        f"magnetometer used for {', '.join(drifts[False])}, but not for {drifting}: the heading of "
        f"{drifting} drifts, and joint rotations drift with it; set the same `magnetometer` for all"
    )


def binding_warning(sources: Sequence[Source]) -> str | None:
    """Return a warning if a rig with cameras has no markers on any segment; None otherwise.

    The configuration is permitted, because a single plate with markers measures the axes of the
    sensors.
    """
    for source in sources:
        settings = source.settings
        if source.kind != "mocap" or any(settings.markers.values()) or settings.rigid_body:
            continue
        only = (
            "only its plate is used, in the align phase"
            if settings.plate
            else "its data are unused"
        )
        return (
            f"[mocap] measures no segment ({only}): add markers.SEGMENT = [names] or "
            "rigid_body.SEGMENT = name, with the names in the stream (`jointfit probe --mocap HOST`"
            " lists them)"
        )
    return None


def rig_warnings(rig: Rig) -> list[str]:
    """Return the warnings about a valid rig."""
    found = (heading_warning(rig.sources), binding_warning(rig.sources))
    return [*missing_files(rig.mqtt), *filter(None, found)]


def _numbers(ids: object) -> Iterator[tuple[str, int]]:
    """Yield the message names and identifiers of an ``ids`` table, which is a model or a dict.

    A model whose identifiers depend on each other has a method ``resolve``.
    """
    resolve = getattr(ids, "resolve", None)
    fields = type(ids).model_fields if isinstance(ids, BaseModel) else {}
    faulty = any(
        field.default is not None and getattr(ids, name) is None for name, field in fields.items()
    )
    if callable(resolve) and not faulty:  # never derive identifiers from a wrong one
        ids = resolve()
    if isinstance(ids, BaseModel):
        ids = dict(ids)
    elif isinstance(ids, tuple) and hasattr(ids, "_asdict"):
        ids = ids._asdict()
    if isinstance(ids, dict):
        for name, number in ids.items():
            if isinstance(number, int) and not isinstance(number, bool):
                yield name, number
