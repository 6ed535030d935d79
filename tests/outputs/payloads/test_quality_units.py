"""Conversion of the calibration quality to the units of MQTT, and its rounding."""

from __future__ import annotations

import math

import numpy as np
import orjson
import pytest

from jointfit_daemon.model import FusionMode, JointState, LimbState, SyncState
from jointfit_daemon.outputs.payloads import encode_pose
from jointfit_daemon.outputs.payloads._quality_units import quality_payload


def test_radians_become_degrees_and_nanoseconds_milliseconds() -> None:
    told = quality_payload({"alignment": {"S1": {"error_rad": math.pi / 2, "lag_ns": -5_527_259}}})
    assert told == {"alignment": {"S1": {"error_deg": 90.0, "lag_ms": -5.527}}}


def test_unit_of_a_key_applies_to_its_table() -> None:
    told = quality_payload({"static": {"spread_rad": {"S1": 0.01, "S2": None}, "still_s": 5.15021}})
    assert told["static"]["spread_deg"] == {"S1": pytest.approx(0.573, abs=1e-3), "S2": None}
    assert told["static"]["still_s"] == 5.15


def test_holdout_tables_get_a_unit() -> None:
    holdout = {
        "method": "anchored",
        "frames": 697,
        "share": 0.4,
        "segments": {"thigh": {"anchored": math.radians(2.5), "sensors": {"S1": math.radians(5)}}},
        "flexion": {"knee": {"mean": np.float64(math.radians(3))}},
    }
    assert quality_payload({"holdout": holdout})["holdout"] == {
        "method": "anchored",
        "frames": 697,
        "share": 0.4,
        "segments_deg": {"thigh": {"anchored": 2.5, "sensors": {"S1": 5.0}}},
        "flexion_deg": {"knee": {"mean": 3.0}},
    }


def test_rotations_and_coefficients_are_not_rounded() -> None:
    parameters = {
        "sensors": {"S1": {"q_sensor_segment": [0.123456789, 0.0, 0.0, 0.99235]}},
        "regression": {"thigh": {"sensors": ["S1"], "stored": [[1.23456789, 0.1]]}},
    }
    assert quality_payload(parameters | {"static": {"still_s": 5.123456}}) == {
        "static": {"still_s": 5.123},
        **parameters,
    }


def test_texts_flags_lists_and_nulls_pass_unchanged() -> None:
    told = {"alignment": None, "body_parts": ["foot", "shank"], "joints": {"fit": True}}
    assert quality_payload(told) == told


def test_unknown_knee_has_keys_and_hip_has_none() -> None:
    lost = [JointState(name, None, None) for name in ("hip", "knee", "ankle")]
    state = LimbState(1, 1, 1, FusionMode.UNCALIBRATED, SyncState.SETTLING, (), (), tuple(lost))
    joints = orjson.loads(encode_pose(state, 0, 1))["joints"]
    nothing = {"p_m": None, "sd_m": None}
    names = ("flexion", "adduction", "rotation")
    keys = [*(f"{name}_deg" for name in (*names, "inner", "sd")), *(f"{n}_deg_s" for n in names)]
    angles = dict.fromkeys([*keys, "patent"], None)
    assert joints == {"hip": nothing, "knee": nothing | angles, "ankle": nothing}
