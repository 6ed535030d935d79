"""Planar rigs in rig.toml: cameras without sensors, and enough markers on every segment."""

from __future__ import annotations

from typing import Any

import pytest

from jointfit_daemon.config import ConfigError, parse_rig

Table = dict[str, Any]


@pytest.fixture
def rig(table: Table) -> Table:
    """Return a planar rig of four segments."""
    del table["imu"]
    table.pop("can", None)
    table["chain"] = {
        "joints": ["hip", "knee", "ankle"], "segments": ["thigh", "shank"],
        "proximal": "pelvis", "distal": "foot", "motion": "planar",
    }  # fmt: skip
    table["mocap"] = {
        "driver": "fakemocap",
        "markers": {
            "pelvis": ["P1"], "thigh": ["T1", "T2"], "shank": ["C1", "C2"], "foot": ["F1"],
        },
    }  # fmt: skip
    return table


def refusals(table: Table) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse_rig(table)
    return [fault.text() for fault in caught.value.faults]


def test_cameras_alone_are_a_rig(rig: Table) -> None:
    loaded = parse_rig(rig)
    assert loaded.chain.planar
    assert [source.id for source in loaded.sources] == ["mocap"]
    assert loaded.calibration.markers["foot"] == ("F1",)
    del rig["chain"]["proximal"], rig["mocap"]["markers"]["pelvis"]
    assert parse_rig(rig).chain.proximal is None


def test_the_same_markers_are_too_few_in_space(rig: Table) -> None:
    rig["chain"]["motion"] = "spatial"
    texts = refusals(rig)
    assert "imu: segment 'thigh' has no sensor, expected at least one" in texts
    assert any("markers.foot = ['F1']: expected at least three different" in t for t in texts)


def test_inner_segments_need_two_markers_and_ends_one(rig: Table) -> None:
    rig["mocap"]["markers"]["thigh"] = ["T1", "T1"]
    del rig["mocap"]["markers"]["foot"]
    texts = refusals(rig)
    assert any(t.startswith("mocap.markers.thigh") and "at least two different" in t for t in texts)
    assert "mocap.markers.foot: expected at least one marker" in texts


def test_sensors_bodies_models_and_missing_cameras_are_refused(rig: Table) -> None:
    rig["imu"] = [{"id": "S1", "segment": "thigh", "driver": "fake", "port": "/dev/nowhere"}]
    assert refusals(rig) == [
        "imu: expected none with chain.motion = planar, which needs cameras only: remove one key"
    ]
    del rig["imu"]
    rig["mocap"]["rigid_body"] = {"shank": "Shank"}
    del rig["mocap"]["markers"]["shank"]
    assert any("followed by single markers" in text for text in refusals(rig))
    del rig["mocap"]
    assert "chain.motion = 'planar': planar motion needs cameras: add [mocap]" in refusals(rig)


def test_one_segment_alone_has_no_joint(rig: Table) -> None:
    rig["chain"] = {"joints": ["a", "b"], "segments": ["thigh"], "motion": "planar"}
    rig["mocap"]["markers"] = {"thigh": ["T1", "T2"]}
    assert any("needs two parts" in text for text in refusals(rig))


def test_branches_and_wrong_marker_lists_are_refused(rig: Table) -> None:
    rig["mocap"]["markers"]["thigh"] = "T1"
    assert any(text.startswith("mocap.markers.thigh") for text in refusals(rig))
    rig["mocap"]["markers"]["thigh"] = ["T1", "T2"]
    del rig["chain"]["joints"]
    rig["chain"]["joint"] = [{"name": "hip", "parent": "thigh", "child": "shank"}]
    assert any("planar motion has no branches" in text for text in refusals(rig))
