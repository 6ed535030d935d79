"""JSON encoding of the payloads that docs/mqtt.md documents.

Invariant: the key of every quantity ends in its unit. Unknown values are null and never 0. No
payload contains NaN, because orjson writes null instead.
"""

from __future__ import annotations

from math import isfinite, pi
from typing import TYPE_CHECKING, Any

import orjson

from jointfit_daemon.kinematics.joint_angles import read_patent
from jointfit_daemon.model import ANGLE_NAMES
from jointfit_daemon.outputs.topics import PAYLOAD_VERSION

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from jointfit_daemon.model import (
        ChainModelState,
        JointAngles,
        LimbState,
        MarkerFitErrors,
        ModelCoordinate,
        OpticalJoint,
        OpticalState,
        RunningCenter,
        RunningCenters,
        SegmentState,
        SensorStates,
        StickFigure,
    )

_OPTIONS = orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_STRICT_INTEGER | orjson.OPT_NON_STR_KEYS
_NS_PER_US, _NS_PER_MS = 1_000, 1_000_000
_HUNDREDTHS = 100.0 * 180.0 / pi
"""Hundredths of a degree in one radian."""
_EXACT = 2**53 - 1
"""Largest integer that every JSON reader represents exactly."""
_ANGLE_KEYS = {
    convention: tuple(f"{name}_deg" for name in names) for convention, names in ANGLE_NAMES.items()
}
_RATE_KEYS = {
    convention: tuple(f"{key}_s" for key in keys) for convention, keys in _ANGLE_KEYS.items()
}
_NO_ANGLES = (None, None, None)
_NO_PATENT: dict[str, float | bool | None] = dict.fromkeys(
    ("alpha_deg", "beta_deg", "gamma_deg", "joint_deg", "gimbal")
)


def encode(payload: Mapping[str, Any]) -> bytes:
    """Return `payload` as JSON.

    An integer that a browser would round becomes null. A lone surrogate becomes a question mark.
    Data of devices and file names may contain these values.
    """
    try:
        return orjson.dumps(payload, _to_json, _OPTIONS)
    except TypeError:
        return orjson.dumps(_sanitize(payload), _to_json, _OPTIONS)


def encode_pose(state: LimbState, offset_ns: int, now_ns: int) -> bytes:
    """Return the payload of ``pose``.

    Parameters
    ----------
    state
        Limb state of one frame.
    offset_ns
        UNIX time minus CLOCK_MONOTONIC, ns.
    now_ns
        Current CLOCK_MONOTONIC time, ns, from which ``age_ms`` is computed.
    """
    return encode(
        {
            "v": PAYLOAD_VERSION,
            "seq": state.seq,
            "t_us": (state.t_ns + offset_ns) // _NS_PER_US,
            "completed_us": (state.completed_ns + offset_ns) // _NS_PER_US,
            "mono_us": state.t_ns // _NS_PER_US,
            "age_ms": round((now_ns - state.t_ns) / _NS_PER_MS, 2),
            "mode": state.mode,
            "sync": state.sync,
            "flags": state.flags,
            "segments": {segment.name: _segment(segment) for segment in state.segments},
            "joints": {joint.name: _joint(state, i) for i, joint in enumerate(state.joints)},
        }
    )


def encode_joint(state: LimbState, number: int, t_us: int) -> bytes:
    """Return the payload of ``joint/NAME``, which contains only scalars, for dashboards.

    Parameters
    ----------
    state
        Limb state of one frame.
    number
        Index of the joint. Joints between two segments have keys for the angles, null if unknown.
    t_us
        UNIX time of the frame, µs.
    """
    scalars = _joint(state, number)
    position = scalars.pop("p_m") or (None, None, None)
    if "patent" in scalars:
        patent = scalars.pop("patent") or _NO_PATENT
        scalars |= {f"patent_{key}": value for key, value in patent.items()}
    scalars |= zip(("x_m", "y_m", "z_m"), position, strict=True)
    return encode({"v": PAYLOAD_VERSION, "t_us": t_us} | scalars)


def encode_optical(state: OpticalState, offset_ns: int) -> bytes:
    """Return the payload of ``optical/pose``; `offset_ns` is described at `encode_pose`."""
    return encode(
        {
            "v": PAYLOAD_VERSION,
            "t_us": (state.t_ns + offset_ns) // _NS_PER_US,
            "frame": state.number,
            "segments": {
                segment.name: {
                    "q": _round_values(segment.q_world_segment, 5),
                    "residual_deg": _degrees(segment.residual),
                    "residual_rms_deg": _degrees(segment.residual_rms),
                }
                for segment in state.segments
            },
            "joints": {
                joint.name: _optical_joint(
                    joint, inner=0 < i < (len(state.segments) or len(state.joints) - 1)
                )
                for i, joint in enumerate(state.joints)
            },
        }
    )


def encode_sensors(states: SensorStates, offset_ns: int) -> bytes:
    """Return the payload of ``sensors/pose``; `offset_ns` is described at `encode_pose`."""
    return encode(
        {
            "v": PAYLOAD_VERSION,
            "seq": states.seq,
            "t_us": (states.t_ns + offset_ns) // _NS_PER_US,
            "sensors": {
                sensor.name: {
                    "q": _round_values(sensor.q_world_sensor, 6),
                    "q_segment": _round_values(sensor.q_world_segment, 6),
                }
                for sensor in states.sensors
            },
            "joints": {name: {"q": _round_values(q, 6)} for name, q in states.joints},
        }
    )


def encode_chain(state: ChainModelState, offset_ns: int) -> bytes:
    """Return the payload of ``optical/chain``; `offset_ns` is described at `encode_pose`."""
    covariance = {} if state.covariance is None else {"covariance": _chain_covariance(state)}
    return encode(
        {
            "v": PAYLOAD_VERSION,
            "t_us": (state.t_ns + offset_ns) // _NS_PER_US,
            "frame": state.number,
            "model": state.model,
            "refined": state.refined,
            "coordinates": {one.name: _coordinate(one) for one in state.coordinates},
            **covariance,
            "error_m": {name: _metres(error) for name, error in state.errors.items()},
            "fit": _fit_errors(state.fit),
            "recent": _fit_errors(state.recent),
            "flags": state.flags,
        }
    )


def _coordinate(one: ModelCoordinate) -> dict[str, float | None]:
    if one.is_angle:
        return {"value_deg": _degrees(one.value), "sd_deg": _degrees(one.sd)}
    return {"value_m": _metres(one.value), "sd_m": _metres(one.sd)}


def _chain_covariance(state: ChainModelState) -> dict[str, Any]:
    """Return the covariance of the coordinates with a value, in the units of the coordinates."""
    known = [one for one in state.coordinates if one.value is not None]
    units = [180.0 / pi if one.is_angle else 1.0 for one in known]
    rows = [
        [float(f"{a * b * value:.4g}") for b, value in zip(units, row, strict=True)]
        for a, row in zip(units, state.covariance or (), strict=True)
    ]
    return {"names": [one.name for one in known], "rows": rows}


def _fit_errors(errors: MarkerFitErrors | None) -> dict[str, Any] | None:
    if errors is None:
        return None
    return {
        "rms_m": _metres(errors.rms),
        "maximum_m": _metres(errors.maximum),
        "accepted": errors.accepted,
    }


def encode_centers(state: RunningCenters, offset_ns: int) -> bytes:
    """Return the payload of ``optical/centers``; `offset_ns` is described at `encode_pose`."""
    return encode(
        {
            "v": PAYLOAD_VERSION,
            "t_us": (state.t_ns + offset_ns) // _NS_PER_US,
            "memory_s": state.memory_s,
            "joints": {center.joint: _running_center(center) for center in state.joints},
        }
    )


def encode_sticks(state: StickFigure, offset_ns: int) -> bytes:
    """Return the payload of ``optical/sticks``; `offset_ns` is described at `encode_pose`."""
    return encode(
        {
            "v": PAYLOAD_VERSION,
            "t_us": (state.t_ns + offset_ns) // _NS_PER_US,
            "frame": state.number,
            "plane": {
                "normal": _round_values(state.normal, 4),
                "off_plane_m": _metres(state.off_plane),
                "refused": state.refused,
            },
            "joints": {
                joint.name: {
                    "p_m": _round_values(joint.position, 4),
                    "error_m": _metres(joint.error),
                    "arc_deg": _degrees(joint.arc),
                    "refused": joint.refused,
                }
                for joint in state.joints
            },
            "sticks": {
                stick.segment: {"ends_m": [_round_values(end, 4) for end in stick.ends]}
                for stick in state.sticks
            },
        }
    )


def _running_center(found: RunningCenter) -> dict[str, Any]:
    covariance, frames, p_value = found.covariance, found.effective_frames, found.p_value
    return {
        "segment": found.segment,
        "center_m": _round_values(found.center, 5),
        "covariance_m2": covariance and [[float(f"{x:.4g}") for x in row] for row in covariance],
        "unseen": [_round_values(direction, 4) for direction in found.unseen],
        "axis": _round_values(found.axis, 4),
        "p_m": _round_values(found.position, 4),
        "arc_deg": _degrees(found.arc),
        "effective_frames": None if frames is None else round(frames, 1),
        "shift_m": _round_values(found.shift, 5),
        "p_value": None if p_value is None else float(f"{p_value:.3g}"),
        "moved": found.moved,
        "refused": found.refused,
    }


def _optical_joint(joint: OpticalJoint, *, inner: bool) -> dict[str, Any]:
    shown: dict[str, Any] = {
        "p_m": _round_values(joint.position, 4),
        "gap_m": _metres(joint.gap),
        "residual_m": _metres(joint.distance),
        "residual_rms_m": _metres(joint.distance_rms),
    }
    if not inner:
        return shown
    keys, errors, rms = _ANGLE_KEYS[joint.convention], joint.residual, joint.residual_rms
    return shown | {
        **_angles(keys, joint.angles),
        "inner_deg": _degrees(joint.inner),
        "residual": None if errors is None else _angles(keys, errors),
        "residual_rms": None if rms is None else _angles(keys, rms),
    }


def _angles(keys: tuple[str, ...], angles: JointAngles | None) -> dict[str, float | None]:
    return dict(zip(keys, map(_degrees, angles or _NO_ANGLES), strict=True))


def _metres(length: float | None) -> float | None:
    return None if length is None else round(length, 4)


def _segment(segment: SegmentState) -> dict[str, Any]:
    return {
        "q": _round_values(segment.q_world_segment, 5),
        "sd_deg": _degrees(segment.sd),
        "used": segment.used,
    }


def _joint(state: LimbState, number: int) -> dict[str, Any]:
    joint = state.joints[number]
    shown: dict[str, Any] = {
        "p_m": _round_values(joint.position, 4),
        "sd_m": _metres(joint.position_sd),
    }
    inner = 0 < number < (len(state.segments) or len(state.joints) - 1)
    if not inner and joint.angles is None:
        return shown  # the ends of the chain have no joint angles
    return shown | {
        **_angles(_ANGLE_KEYS[joint.convention], joint.angles),
        "inner_deg": _degrees(joint.inner),
        "sd_deg": _degrees(joint.angle_sd),
        **_angles(_RATE_KEYS[joint.convention], joint.rates),
        "patent": _patent(state, number) if inner else None,
    }


def _patent(state: LimbState, number: int) -> dict[str, float | bool | None] | None:
    """Return a joint's angles by the patent's definition; None if an orientation is unknown."""
    if number >= len(state.segments):
        return None
    proximal = state.joints[number].proximal
    above = state.segments[number - 1 if proximal is None else proximal].q_world_segment
    below = state.segments[number].q_world_segment
    if above is None or below is None:
        return None
    alpha, beta, gamma, joint, gimbal = read_patent(above, below)
    return {
        "alpha_deg": _degrees(alpha),
        "beta_deg": _degrees(beta),
        "gamma_deg": _degrees(gamma),
        "joint_deg": _degrees(joint),
        "gimbal": gimbal,
    }


def _degrees(angle: float | None) -> float | None:
    """Return `angle`, rad, in degrees with two decimals; None if it is not finite.

    Rounding to an integer and dividing takes a third of the time of ``round(x, 2)``, and a pose has
    forty such numbers.
    """
    if angle is None or not isfinite(whole := angle * _HUNDREDTHS):
        return None
    return round(whole) / 100.0


def _round_values(values: Iterable[float] | None, digits: int) -> list[float | None] | None:
    if values is None:
        return None
    scale = 10.0**digits
    return [round(whole) / scale if isfinite(whole := value * scale) else None for value in values]


def _sanitize(value: object) -> object:
    """Return `value`, in which integers and characters that JSON cannot represent are replaced."""
    if isinstance(value, int):
        return value if abs(value) <= _EXACT else None
    if isinstance(value, str):
        return value.encode("utf-8", "replace").decode("utf-8")
    if isinstance(value, list | tuple | set | frozenset):
        return [_sanitize(item) for item in value]
    if hasattr(value, "items"):
        return {_sanitize(key): _sanitize(item) for key, item in value.items()}
    return value


def _to_json(value: object) -> object:
    """Return a JSON-compatible value for an object that orjson does not support."""
    if isinstance(value, tuple | set | frozenset):  # includes named tuples
        return list(value)
    if isinstance(value, bytes):
        return value.hex()
    if hasattr(value, "items"):  # a mapping proxy
        return dict(value.items())
    return str(value)
