"""The check names each fault of a stored calibration, and accepts values at their limits."""

from __future__ import annotations

import json
import math
from base64 import b64encode
from typing import Any

import pytest

from jointfit_daemon.calibration.record._content_check import _PROBES, content_faults
from jointfit_daemon.limb_model import Calibration
from tests.calibration import calibrated_subject

ONE = [1.0, 0.0, 0.0, 0.0]
CENTER = {
    "center": [0.0, 0.1, 0.9],
    "covariance": [[1e-6, 0.0, 0.0], [0.0, 1e-6, 0.0], [0.0, 0.0, 1e-6]],
    "unseen": [[0.6, 0.0, 0.8]],
}
LINK = {
    "a": "S1", "b": "S2", "kind": "pair", "near": ["S3"], "weights": [[0.0] * 10] * 3,
    "low": [-1.0] * 10, "high": [1.0] * 10, "spread": 0.01, "total": 0.1,
    "uncertainty": [[0.02] * 10] * 10,
}  # fmt: skip
CHAIN = {"model": "leg", "fingerprint": "f", "positions": {"A": [0.0, 0.1, 0.2]}}


def content() -> dict[str, Any]:
    """Return the JSON form of a calibration with every kind of record."""
    found = calibrated_subject.calibration().to_dict()
    found.update(links=[LINK], correlations={"knee": 0.5}, chain=CHAIN)
    found["joint"]["hip"].update(center=[0.0, 0.1, 0.9], sd=0.01, source="fit", rotation=CENTER)
    copied: dict[str, Any] = json.loads(json.dumps(found))
    return copied


def faults_with(path: str, value: object) -> list[str]:
    """Return the faults of a calibration in which the value at a path is replaced.

    Numbers in the path are indices.
    """
    changed = content()
    table: Any = changed
    *keys, last = [int(key) if key.isdigit() else key for key in path.split("/")]
    for key in keys:
        table = table[key]
    table[last] = value
    return content_faults(Calibration.from_dict(changed))


def test_a_calibration_with_every_kind_of_record_has_no_fault() -> None:
    assert content_faults(Calibration.from_dict(content())) == []


def test_models_are_evaluated_with_three_different_orientations() -> None:
    assert len(set(_PROBES)) == 3
    assert [math.hypot(*q) for q in _PROBES] == pytest.approx([1.0] * 3)


@pytest.mark.parametrize(
    ("path", "value", "fault"),
    [
        ("method", "mood", "method 'mood', expected one of anchored, patent12, patent6, markley,"),
        ("procedure", "new", "procedure 'new', expected one of corrected, patent"),
        ("flags", [1], "flags, notes, digest, software, created_utc and memory must be text"),
        ("notes", [None], "flags, notes, digest, software, created_utc and memory must be text"),
        ("software", 3, "flags, notes, digest, software, created_utc and memory must be text"),
        ("created_utc", 3, "flags, notes, digest, software, created_utc and memory must be text"),
        ("memory", b64encode(b"abc").decode(), "memory: truncated"),
        ("memory", "!", "Error: Only base64 data is allowed"),
        ("segments", ["thigh", "calf"], "segment: expected thigh, calf, found thigh, shank"),
        ("sensor", {}, "sensor: expected S1, S2, S3, found none"),
        ("joint/foot", {**CENTER, "sd": 0.1, "source": "fit", "residual_rms": None,
                        "gap_rms": None}, "joint: expected hip, knee, ankle, found hip, knee, an"),
        ("sensor/S1/q_optical_world", [1.0, 0.0, 0.0, 0.002], "sensor.S1.q_optical_world: [1.0, "),
        ("sensor/S1/q_sensor_segment", [0.0] * 4, "sensor.S1.q_sensor_segment: [0.0, 0.0, 0.0, "),
        ("sensor/S1/lag_ns", 10**10 + 1, "sensor.S1.lag_ns: 10000000001"),
        ("sensor/S1/lag_ns", -(10**10) - 1, "sensor.S1.lag_ns: -10000000001"),
        ("sensor/S1/spread", -1e-9, "sensor.S1.spread: -1e-09"),
        ("sensor/S1/spread", 1000.5, "sensor.S1.spread: 1000.5"),
        ("segment/thigh/q_static", [1.0, 0.1, 0.0, 0.0], "segment.thigh.q_static: [1.0, 0.1, 0.0"),
        ("segment/thigh/length", 10.5, "segment.thigh.length: 10.5"),
        ("segment/thigh/length_sd", -0.1, "segment.thigh.length_sd: -0.1"),
        ("joint/hip/center", [0.0, 0.0, 1000.5], "joint.hip.center: expected 3 finite numbers"),
        ("joint/hip/center", [0.0, -1000.5, 0.0], "joint.hip.center: expected 3 finite numbers"),
        ("joint/hip/rotation/center/0", 2e3, "joint.hip.rotation.center: expected 3 finite numb"),
        ("joint/hip/rotation/covariance/2/2", 2e3, "joint.hip.rotation.covariance: expected 3 x "),
        ("joint/hip/rotation/unseen/0/0", 2e3, "joint.hip.rotation.unseen: expected 3 finite num"),
        ("joint/hip/source", 3, "joint.hip.source: 3"),
        ("joint/hip/sd", 1000.5, "joint.hip.sd: 1000.5"),
        ("joint/hip/residual_rms", True, "joint.hip.residual_rms: True"),
        ("joint/hip/gap_rms", "small", "joint.hip.gap_rms: 'small'"),
        ("clusters/thigh/markers", ["A", "A", "B", "C"], "clusters.thigh.markers: expected diffe"),
        ("clusters/thigh/markers", ["A", "B", "C"], "clusters.thigh.template: expected 3 x 3 fin"),
        ("clusters/thigh/body", 3, "clusters.thigh.body: 3"),
        ("clusters/thigh/origin", [0.0, 0.0, 2e3], "clusters.thigh.origin: expected 3 finite num"),
        ("clusters/thigh/q_body", [2.0, 0.0, 0.0, 0.0], "clusters.thigh.q_body: [2.0, 0.0, 0.0, "),
        ("chain/model", 3, "chain: model and fingerprint must be text"),
        ("chain/fingerprint", 3, "chain: model and fingerprint must be text"),
        ("chain/positions/A/1", 2e3, "chain.positions.A: expected 3 finite numbers"),
        ("links/0/a", "S9", "links S9-S2: contains an unknown sensor"),
        ("links/0/b", "S9", "links S1-S9: contains an unknown sensor"),
        ("links/0/near/0", "S9", "links S1-S2: contains an unknown sensor"),
        ("links/0/kind", "trio", "links S1-S2: kind 'trio'"),
        ("links/0/kind", "joint", "links S1-S2.weights: expected 1 x 10 finite numbers"),
        ("links/0/low", [0.0] * 9, "links S1-S2.low: expected 10 finite numbers"),
        ("links/0/high", [0.0] * 11, "links S1-S2.high: expected 10 finite numbers"),
        ("links/0/uncertainty", [[0.0] * 10] * 9, "links S1-S2.uncertainty: expected 10 x 10 fin"),
        ("links/0/spread", -0.1, "links S1-S2: spread and total must be standard deviations"),
        ("links/0/total", 1000.5, "links S1-S2: spread and total must be standard deviations"),
        ("correlations", {"nose": 0.5}, "correlations.nose: 0.5"),
        ("quality", {"static": 3}, "quality.static: expected a table"),
        ("quality", {"holdout": {"segments": {"thigh": 3}}}, "quality.holdout.segments.thigh: ex"),
        ("quality", {"holdout": {"flexion": {"knee": 3}}}, "quality.holdout.flexion.knee: expect"),
        ("quality", {"lag": {"S1": []}}, "quality.lag.S1: expected a table with sigma_ns"),
        ("quality", {"lag": {"S1": {"sigma_ns": -1}}}, "quality.lag.S1: expected a table with si"),
        ("quality", {"online": {"rounds": -1}}, "quality.online.rounds: -1"),
        ("quality", {"online": {"rounds": 1.5}}, "quality.online.rounds: 1.5"),
        ("quality", {"online": {"rounds": True}}, "quality.online.rounds: True"),
    ],
)  # fmt: skip
def test_the_only_fault_is_named_with_the_value(path: str, value: object, fault: str) -> None:
    (found,) = faults_with(path, value)
    assert fault in found


@pytest.mark.parametrize(
    ("path", "value", "fault"),
    [
        ("joints", ["hip", "knee", "knee"], "joints: expected different names, found ['hip', 'kn"),
        ("joints", ["hip", "knee", ""], "joints: expected different names, found ['hip', 'knee',"),
        ("chain_sensors/0/0", "S9", "sensor: expected S9, S2, S3, found S1, S2, S3"),
    ],
)  # fmt: skip
def test_a_wrong_name_is_the_first_fault(path: str, value: object, fault: str) -> None:
    assert fault in faults_with(path, value)[0]


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("sensor/S1/lag_ns", 10**10),
        ("sensor/S1/lag_ns", -(10**10)),
        ("sensor/S1/spread", 0.0),
        ("sensor/S1/spread", 1000.0),
        ("sensor/S1/q_optical_world", [1.0 + 5e-7, 0.0, 0.0, 0.0]),
        ("segment/thigh/length", 10.0),
        ("segment/thigh/length", None),
        ("segment/thigh/length_sd", 0.0),
        ("joint/hip/center", [1000.0, -1000.0, 0.0]),
        ("joint/hip/sd", 1000.0),
        ("joint/hip/gap_rms", None),
        ("links/0/uncertainty", []),
        ("links/0/spread", 0.0),
        ("chain", None),
        ("quality", {"static": None, "lag": {"S1": {"sigma_ns": None}}}),
        ("quality", {"lag": {"S1": {"sigma_ns": 0.0}}, "online": {"rounds": 0}}),
        ("quality", {"holdout": {"segments": None}, "other": {"anything": "is published"}}),
    ],
)
def test_a_value_at_its_limit_is_no_fault(path: str, value: object) -> None:
    assert faults_with(path, value) == []


def branched(parents: list[Any], left_joints: list[Any]) -> list[str]:
    """Return the faults of a limb with two joints on its first segment."""
    found = content()
    joint = found["joint"]["knee"]
    names = ["center", "right", "left", "knee"]
    found.update(joints=names, joint=dict.fromkeys(names, joint))
    found.update(parents=parents, left_joints=left_joints)
    return content_faults(Calibration.from_dict(found))


LEFT = [False, False, True, False]


def test_a_branched_limb_has_no_fault() -> None:
    assert branched([None, 0, 0, 1], LEFT) == []
    assert branched([None, 0, 0, 1], [False, True, False, True]) == []


@pytest.mark.parametrize(
    ("parents", "left_joints", "fault"),
    [
        ([None, 0, 0], LEFT, "parents and left_joints: expected 4 entries, one for each joint"),
        ([None, 0, 0, 1], LEFT[:3], "parents and left_joints: expected 4 entries, one for each"),
        ([], LEFT, "parents and left_joints: expected 4 entries, one for each joint"),
        ([None, 0, 0, 1], [0, 0, 1, 0], "left_joints: [0, 0, 1, 0], expected true or false"),
        ([0, 0, 0, 1], LEFT, "parents: [0, 0, 0, 1], expected null and numbers of earlier segm"),
        ([None, 0, 0, True], LEFT, "parents: [None, 0, 0, True], expected null and numbers of e"),
        ([None, 0, 0, 2], LEFT, "parents: [None, 0, 0, 2], expected null and numbers of earlier"),
        ([None, 0, 0, -1], LEFT, "parents: [None, 0, 0, -1], expected null and numbers of earl"),
        ([None, 1, 0, 0], LEFT, "parents: [None, 1, 0, 0], expected null and numbers of earlier"),
        ([None, 0, 0, 0], LEFT, "parents: [None, 0, 0, 0], expected two joints on the first seg"),
        ([None, 0, 1, 1], LEFT, "parents: [None, 0, 1, 1], expected two joints on the first seg"),
        ([None, 0, 0, 1], [False] * 4, "left_joints: expected one right and one left joint on"),
        ([None, 0, 0, 1], [False, True, True, False], "left_joints: expected one right and one"),
        ([None, 0, 1, 0], LEFT, "left_joints: expected one right and one left joint on the first"),
    ],
)
def test_each_fault_of_a_branched_limb_is_named(
    parents: list[Any], left_joints: list[Any], fault: str
) -> None:
    (found,) = branched(parents, left_joints)
    assert found.startswith(fault)
