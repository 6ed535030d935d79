"""Figures on the wire: every one with its unit, in degrees and milliseconds, or null."""

from __future__ import annotations

import math

import numpy as np
import orjson
import pytest

from jointfit_daemon.model import JointState, LimbState
from jointfit_daemon.outputs.payloads import encode_pose
from jointfit_daemon.outputs.payloads._quality_units import shown


def test_radians_are_told_in_degrees_and_nanoseconds_in_milliseconds() -> None:
    told = shown({"alignment": {"S1": {"error_rad": math.pi / 2, "lag_ns": -5_527_259}}})
    assert told == {"alignment": {"S1": {"error_deg": 90.0, "lag_ms": -5.527}}}


def test_a_unit_counts_for_the_whole_table_that_hangs_from_it() -> None:
    told = shown({"static": {"spread_rad": {"S1": 0.01, "S2": None}, "still_s": 5.15021}})
    assert told["static"]["spread_deg"] == {"S1": pytest.approx(0.573, abs=1e-3), "S2": None}
    assert told["static"]["still_s"] == 5.15


def test_the_tables_of_the_holdout_get_the_unit_they_lack() -> None:
    holdout = {
        "method": "anchored",
        "frames": 697,
        "share": 0.4,
        "segments": {"thigh": {"anchored": math.radians(2.5), "sensors": {"S1": math.radians(5)}}},
        "flexion": {"knee": {"mean": np.float64(math.radians(3))}},
    }
    assert shown({"holdout": holdout})["holdout"] == {
        "method": "anchored",
        "frames": 697,
        "share": 0.4,
        "segments_deg": {"thigh": {"anchored": 2.5, "sensors": {"S1": 5.0}}},
        "flexion_deg": {"knee": {"mean": 3.0}},
    }


def test_words_flags_lists_and_what_is_unknown_pass_unchanged() -> None:
    told = {"alignment": None, "body_parts": ["foot", "shank"], "joints": {"fit": True}}
    assert shown(told) == told


def test_a_knee_that_is_unknown_keeps_its_keys_and_a_hip_has_none() -> None:
    lost = [JointState(name, None, None) for name in ("hip", "knee", "ankle")]
    state = LimbState(1, 1, 1, "uncalibrated", "settling", (), (), tuple(lost))
    joints = orjson.loads(encode_pose(state, 0, 1))["joints"]
    nothing = {"p_m": None, "sd_m": None}
    names = ("flexion", "adduction", "rotation")
    keys = [*(f"{name}_deg" for name in (*names, "inner", "sd")), *(f"{n}_deg_s" for n in names)]
    angles = dict.fromkeys([*keys, "patent"], None)
    assert joints == {"hip": nothing, "knee": nothing | angles, "ankle": nothing}
