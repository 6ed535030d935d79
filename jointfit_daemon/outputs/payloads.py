"""What is written on the topics, as bytes. Law: pure; the contract is docs/mqtt.md.

Every number's key ends in its unit; unknown is null, never 0; NaN cannot get out (orjson writes
null). UNIX time appears here and nowhere deeper.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import orjson

from jointfit_daemon.outputs.mqtt import PAYLOAD_VERSION

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from jointfit_daemon.model import JointState, LimbState, SegmentState

_OPTIONS = orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_STRICT_INTEGER | orjson.OPT_NON_STR_KEYS
_NS_PER_US, _NS_PER_MS = 1_000, 1_000_000


def encode(payload: Mapping[str, Any]) -> bytes:
    """Return `payload` as JSON; integers a browser would round are refused with TypeError."""
    return orjson.dumps(payload, _plain, _OPTIONS)


def encode_pose(state: LimbState, offset_ns: int, now_ns: int) -> bytes:
    """Return the payload of ``pose``.

    Parameters
    ----------
    state
        One frame.
    offset_ns
        UNIX time minus CLOCK_MONOTONIC.
    now_ns
        Now, CLOCK_MONOTONIC: gives ``age_ms``.
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
            "joints": {
                joint.name: _joint(joint, inner=0 < i < len(state.joints) - 1)
                for i, joint in enumerate(state.joints)
            },
        }
    )


def encode_joint(joint: JointState, t_us: int, *, inner: bool = False) -> bytes:
    """Return the payload of ``joint/NAME``: scalars only, for plain dashboards.

    A joint between two segments (`inner`) has angles even while they are unknown.
    """
    scalars: dict[str, Any] = {"v": PAYLOAD_VERSION, "t_us": t_us, **_joint(joint, inner=inner)}
    position = scalars.pop("p_m") or (None, None, None)
    return encode(scalars | dict(zip(("x_m", "y_m", "z_m"), position, strict=True)))


def _segment(segment: SegmentState) -> dict[str, Any]:
    return {
        "q": _rounded(segment.q_world_segment, 5),
        "sd_deg": _degrees(segment.sd),
        "used": segment.used,
    }


def _joint(joint: JointState, *, inner: bool) -> dict[str, Any]:
    shown: dict[str, Any] = {
        "p_m": _rounded(joint.position, 4),
        "sd_m": None if joint.position_sd is None else round(joint.position_sd, 4),
    }
    if not inner and joint.angles is None and joint.inner is None:
        return shown  # an end of the chain has no angles
    flexion, adduction, rotation = joint.angles or (None, None, None)
    rates = joint.rates or (None, None, None)
    return shown | {
        "flexion_deg": _degrees(flexion),
        "adduction_deg": _degrees(adduction),
        "rotation_deg": _degrees(rotation),
        "inner_deg": _degrees(joint.inner),
        "sd_deg": _degrees(joint.angle_sd),
        "flexion_deg_s": _degrees(rates[0]),
        "adduction_deg_s": _degrees(rates[1]),
        "rotation_deg_s": _degrees(rates[2]),
    }


def _degrees(angle: float | None) -> float | None:
    return None if angle is None else round(math.degrees(angle), 2)


def _rounded(values: Iterable[float] | None, digits: int) -> list[float] | None:
    return None if values is None else [round(value, digits) for value in values]


def _plain(value: object) -> object:
    """Return what orjson cannot write as something it can."""
    if isinstance(value, tuple | set | frozenset):  # named tuples among them
        return list(value)
    if isinstance(value, bytes):
        return value.hex()
    if hasattr(value, "items"):  # a mapping proxy
        return dict(value.items())
    return str(value)
