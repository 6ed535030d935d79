"""Check of the content of a stored calibration: types, shapes, ranges and names.

Invariant: a calibration in which this check finds no fault causes no error in other code. The check
also evaluates the models, because the shapes of their arrays depend on each other.
"""

from __future__ import annotations

from base64 import b64decode
from dataclasses import fields, is_dataclass
from math import inf, isfinite, sqrt
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from jointfit_daemon.limb_model import Method, PatentReading, Procedure

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from jointfit_daemon.limb_model import Calibration, SegmentCalibration, SegmentModel, SensorLink

_UNIT = 1e-6
"""Tolerance of the norm of a unit quaternion; rounding in text is 1e-16."""
_LONGEST_M = 10.0
"""Largest length of a segment, m."""
_FARTHEST_M = 1000.0
"""Largest coordinate, m."""
_LONGEST_LAG_NS = 10**10
_LARGEST_SD = 1e3
_LARGEST = 1e12
"""Largest coefficient of a model."""
_POLYNOMIALS = 10
_COMPONENTS = {"pair": 3, "joint": 1}
_HALF = sqrt(0.5)
_PROBES = ((1.0, 0.0, 0.0, 0.0), (_HALF, _HALF, 0.0, 0.0), (0.5, -0.5, 0.5, 0.5))
"""Orientations with which every model is evaluated."""


def content_faults(calibration: Calibration) -> list[str]:
    """Return the faults of a calibration, one phrase each; empty if the calibration is usable."""
    try:
        return list(_faults(calibration))
    except Exception as error:  # noqa: BLE001 - a wrong type may raise any error
        return [f"{type(error).__name__}: {error}"]


def _faults(c: Calibration) -> Iterator[str]:
    if c.method not in get_args(Method):
        yield f"method {c.method!r}, expected one of {', '.join(get_args(Method))}"

    if c.procedure not in get_args(Procedure):
        yield f"procedure {c.procedure!r}, expected one of {', '.join(get_args(Procedure))}"

    texts = (*c.flags, *c.notes, c.digest, c.software, c.created_utc, c.memory)
    if not all(isinstance(text, str) for text in texts):
        yield "flags, notes, digest, software, created_utc and memory must be text"
    if len(b64decode(c.memory, validate=True)) % 2:
        yield "memory: truncated"

    sensors = [name for group in c.chain_sensors for name in group]
    yield from _names("joints", c.joints)
    yield from _names("segments", c.segments)
    yield from _names("chain_sensors", sensors)
    yield from _same("sensor", c.sensor, sensors)
    yield from _same("segment", c.segment, c.segments)
    yield from _same("joint", c.joint, c.joints)

    yield from _branches(c)

    # The content of each record.
    yield from _sensors(c)
    for name, segment in c.segment.items():
        yield from _segment(name, segment)
    yield from _joints(c)
    yield from _clusters(c)
    yield from _chain(c)
    for link in c.links:
        yield from _link(link, sensors)
    yield from _quality(c.quality)
    for name, rho in c.correlations.items():
        if name not in c.joints or not _number(rho, -1.0, 1.0):
            yield f"correlations.{name}: {rho!r}"


def _branches(c: Calibration) -> Iterator[str]:
    """Yield the faults in `parents` and `left_joints`, which describe the branches of a limb."""
    if not c.parents and not c.left_joints:
        return
    if not len(c.parents) == len(c.left_joints) == len(c.joints) > len(c.segments):
        yield f"parents and left_joints: expected {len(c.joints)} entries, one for each joint"
        return
    if not all(isinstance(left, bool) for left in c.left_joints):
        yield f"left_joints: {list(c.left_joints)!r:.80}, expected true or false"

    first, *others = c.parents
    known = [
        type(parent) is int and 0 <= parent < min(joint, len(c.segments))
        for joint, parent in enumerate(others, 1)
    ]
    if first is not None or not all(known):
        yield f"parents: {list(c.parents)!r:.80}, expected null and numbers of earlier segments"
        return
    counts = [others.count(segment) for segment in range(len(c.segments))]
    if counts[0] != 2 or any(count != 1 for count in counts[1:]):
        yield f"parents: {list(c.parents)!r:.80}, expected two joints on the first segment only"
    elif sum(c.left_joints[j] for j, parent in enumerate(c.parents) if parent == 0) != 1:
        yield "left_joints: expected one right and one left joint on the first segment"


def _sensors(c: Calibration) -> Iterator[str]:
    for name, sensor in c.sensor.items():
        for key in ("q_optical_world", "q_sensor_segment"):
            yield from _unit(f"sensor.{name}.{key}", getattr(sensor, key))
        if not _number(sensor.lag_ns, -_LONGEST_LAG_NS, _LONGEST_LAG_NS):
            yield f"sensor.{name}.lag_ns: {sensor.lag_ns!r}"
        if not _number(sensor.spread, 0.0, _LARGEST_SD):
            yield f"sensor.{name}.spread: {sensor.spread!r}"


def _segment(name: str, segment: SegmentCalibration) -> Iterator[str]:
    yield from _unit(f"segment.{name}.q_static", segment.q_static)
    yield from _fields_out_of_range(f"segment.{name}", segment, ("length", "length_sd"), _LONGEST_M)
    for key, model in segment.models.items():
        sensors, bar, other = key.partition("|")
        if not bar:
            yield f"segment.{name}.models: {key!r} is not a set of sensors"
        elif wrong := [*_wrong_types(model)]:
            yield f"segment.{name}.models[{key}]: wrong type of {', '.join(wrong)}"
        elif fault := _model(model, len(sensors.split("+")), has_other=bool(other)):
            yield f"segment.{name}.models[{key}]: {fault}"


def _wrong_types(model: Any) -> Iterator[str]:
    """Yield the fields of a model whose values do not have the annotated type.

    `_model` does not find these faults, because an evaluation does not use the fields that apply
    only after the loss of a sensor.
    """
    for field in fields(model):
        value = getattr(model, field.name)
        if field.name.startswith("_"):  # private fields are derived from other fields
            continue
        if is_dataclass(value):
            yield from (f"{field.name}.{name}" for name in _wrong_types(value))
        elif not _is_of(value, str(field.type)):
            yield field.name


def _is_of(value: object, annotation: str) -> bool:
    if annotation == "bool":
        return isinstance(value, bool)
    if annotation == "int":
        return isinstance(value, int) and _number(value, 0, _LARGEST)
    if annotation == "PatentReading":
        return value in get_args(PatentReading)
    if annotation == "float":
        return _number(value, -_LARGEST, _LARGEST)
    return isinstance(value, tuple) and all(_is_numeric(item) for item in value)


def _is_numeric(value: object) -> bool:
    if isinstance(value, tuple):
        return all(_is_numeric(item) for item in value)
    return _number(value, -_LARGEST, _LARGEST)


def _model(model: SegmentModel, count: int, *, has_other: bool) -> str | None:
    """Return the reason why a model does not return orientations, or None."""
    if (trained := getattr(model, "sensors", count)) != count:
        return f"trained for {trained!r} sensors, expected {count}"
    for i in range(len(_PROBES)):
        sensors = [_PROBES[(i + k) % len(_PROBES)] for k in range(count)]
        other = _PROBES[i - 1] if has_other else None
        found = model.predict_one(sensors, other)
        sds = (found.sd, *(found.axis_sd or ()))
        if not _is_unit(found.q) or not all(_number(sd, 0.0, _LARGEST_SD) for sd in sds):
            return "returns no orientation with a standard deviation"
    return None if _number(model.residual_sd, 0.0, _LARGEST_SD) else "residual_sd is not a number"


def _quality(quality: Mapping[str, Any]) -> Iterator[str]:
    """Check the quality figures that the program uses; others are published unchanged."""
    for key, section in quality.items():
        if not (section is None or isinstance(section, dict)):
            yield f"quality.{key}: expected a table"
            return

    for key in ("segments", "flexion"):
        for name, figures in (quality.get("holdout", {}).get(key) or {}).items():
            if not isinstance(figures, dict):
                yield f"quality.holdout.{key}.{name}: expected a table"
    for name, lag in (quality.get("lag") or {}).items():
        if not (isinstance(lag, dict) and _number_or_none(lag.get("sigma_ns"), 0.0, inf)):
            yield f"quality.lag.{name}: expected a table with sigma_ns"
    rounds = (quality.get("online") or {}).get("rounds", 0)
    if not _is_of(rounds, "int"):
        yield f"quality.online.rounds: {rounds!r}"


def _joints(c: Calibration) -> Iterator[str]:
    for name, joint in c.joint.items():
        if joint.center is not None:
            yield from _finite(f"joint.{name}.center", joint.center, (3,))
        if (found := joint.rotation) is not None:
            key = f"joint.{name}.rotation"
            yield from _finite(f"{key}.center", found.center, (3,))
            yield from _finite(f"{key}.covariance", found.covariance, (3, 3))
            for direction in found.unseen:
                yield from _finite(f"{key}.unseen", direction, (3,))
        if not _is_text(joint.source):
            yield f"joint.{name}.source: {joint.source!r}"
        yield from _fields_out_of_range(
            f"joint.{name}", joint, ("sd", "residual_rms", "gap_rms"), _LARGEST_SD
        )


def _clusters(c: Calibration) -> Iterator[str]:
    for name, cluster in c.clusters.items():
        key = f"clusters.{name}"
        yield from _names(f"{key}.markers", cluster.markers)
        if not (cluster.body is None or _is_text(cluster.body)):
            yield f"{key}.body: {cluster.body!r}"
        # The pose of a rigid body does not depend on its template.
        count = len(cluster.markers) if cluster.body is None else len(cluster.template)
        if count or cluster.template:
            yield from _finite(f"{key}.template", cluster.template, (count, 3))
        yield from _finite(f"{key}.origin", cluster.origin, (3,))
        yield from _unit(f"{key}.q_body", cluster.q_body)


def _chain(c: Calibration) -> Iterator[str]:
    if c.chain is None:
        return
    if not (_is_text(c.chain.model) and _is_text(c.chain.fingerprint)):
        yield "chain: model and fingerprint must be text"
    for name, position in c.chain.positions.items():
        yield from _finite(f"chain.positions.{name}", position, (3,))


def _link(link: SensorLink, sensors: Sequence[str]) -> Iterator[str]:
    key = f"links {link.a}-{link.b}"
    if not {link.a, link.b, *link.near} <= set(sensors):
        yield f"{key}: contains an unknown sensor"
    if link.kind not in _COMPONENTS:
        yield f"{key}: kind {link.kind!r}"
        return
    yield from _finite(f"{key}.weights", link.weights, (_COMPONENTS[link.kind], _POLYNOMIALS))
    yield from _finite(f"{key}.low", link.low, (_POLYNOMIALS,))
    yield from _finite(f"{key}.high", link.high, (_POLYNOMIALS,))
    if link.uncertainty:
        yield from _finite(f"{key}.uncertainty", link.uncertainty, (_POLYNOMIALS, _POLYNOMIALS))
    if not (_number(link.spread, 0.0, _LARGEST_SD) and _number(link.total, 0.0, _LARGEST_SD)):
        yield f"{key}: spread and total must be standard deviations"


# --- values -----------------------------------------------------------------------------------


def _names(key: str, names: Sequence[Any]) -> Iterator[str]:
    if not all(isinstance(name, str) and name for name in names) or len(set(names)) != len(names):
        yield f"{key}: expected different names, found {list(names)!r:.80}"


def _same(key: str, found: Mapping[str, Any], names: Sequence[str]) -> Iterator[str]:
    if set(found) != set(names):
        yield f"{key}: expected {', '.join(names)}, found {', '.join(found) or 'none'}"


def _fields_out_of_range(
    key: str, record: object, names: Sequence[str], largest: float
) -> Iterator[str]:
    """Yield the fields that are neither None nor a number from 0 to `largest`."""
    for name in names:
        if not _number_or_none(value := getattr(record, name), 0.0, largest):
            yield f"{key}.{name}: {value!r}"


def _finite(key: str, values: Any, shape: tuple[int, ...]) -> Iterator[str]:
    flat = [value for row in values for value in (row if len(shape) > 1 else (row,))]
    if np.shape(values) != shape or not all(_number(v, -_FARTHEST_M, _FARTHEST_M) for v in flat):
        yield f"{key}: expected {' x '.join(map(str, shape))} finite numbers"


def _unit(key: str, q: Sequence[float]) -> Iterator[str]:
    if not _is_unit(q):
        yield f"{key}: {list(q)!r:.80} is not a unit quaternion"


def _is_unit(q: Sequence[float]) -> bool:
    return len(q) == 4 and abs(sqrt(sum(value * value for value in q)) - 1.0) < _UNIT


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _number(value: object, low: float, high: float) -> bool:
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return False
    return isfinite(value) and low <= value <= high


def _number_or_none(value: object, low: float, high: float) -> bool:
    return value is None or _number(value, low, high)
