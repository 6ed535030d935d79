"""The QTM settings parser reads the vendor's examples and older layouts, and refuses others."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols.qtm import QtmBody, QtmSettingsXml, parse_settings

if TYPE_CHECKING:
    from pathlib import Path


def example(shared_data: Path, name: str) -> QtmSettingsXml:
    path = shared_data / "mocap" / "qtm_xml_cpp_sdk" / name
    if not path.is_file():
        pytest.skip(f"{path} is absent")
    found = parse_settings(path.read_text(encoding="utf-8"))
    assert found is not None
    return found


def test_six_bodies_of_the_vendor_are_read_in_order(shared_data: Path) -> None:
    found = example(shared_data, "6d_Get6DSettingsTest.xml")
    assert found.bodies is not None
    names = [(body.name, len(body.points)) for body in found.bodies]
    assert names == [
        ("refined", 6), ("Table", 4), ("Screen2", 4), ("Cup", 5), ("Phone", 4), ("Screen1", 4),
    ]  # fmt: skip
    assert found.bodies[0].points[0] == "Layout 3 - 1"
    assert all(body.enabled and not body.relative and not body.fixed for body in found.bodies)


def test_labels_and_the_vertical_axis_are_read(shared_data: Path) -> None:
    found = example(shared_data, "3d_Get3DSettingsTest.xml")
    assert found.labels is not None
    assert (len(found.labels), len(set(found.labels))) == (72, 72)
    assert (found.labels[0], found.labels[-1]) == ("VF_LeftShoulder", "Screen - 4")
    assert (found.up_axis, found.calibrated) == ("+Z", "2019-09-17 16:00:43")


def test_the_general_part_tells_that_there_is_no_camera_time_and_no_bodies(
    shared_data: Path,
) -> None:
    found = example(shared_data, "General_GetGeneralSettingsTest.xml")
    assert (found.frequency_hz, found.timestamp_enabled) == (100, False)
    assert (found.timestamp_type, found.tracks_bodies) == ("SMPTE", False)
    assert (found.bodies, found.labels) == (None, None)


def test_nested_segments_of_skeletons_are_read(shared_data: Path) -> None:
    found = example(shared_data, "Skeleton_SkeletonSettingsGet.xml")
    assert found.skeletons is not None
    assert [s.name for s in found.skeletons] == ["skeleton1", "skeleton2"]
    segments = [segment for s in found.skeletons for segment in s.segments]
    assert sorted(segments) == [(1, "segment1"), (2, "segment2"), (3, "segment3")]


def test_the_layout_before_version_1_21_is_read() -> None:
    text = (
        "\n<QTM_Parameters_Ver_1.20><The_6D><Bodies>2</Bodies><Body><Name>A</Name><RGBColor>1"
        "</RGBColor><Point><X>1</X><Y>2</Y><Z>3</Z></Point></Body><Body><Name>B</Name></Body>"
        "</The_6D></QTM_Parameters_Ver_1.20>\n"
    )
    found = parse_settings(text)
    assert found is not None
    assert found.bodies == (QtmBody("A", points=("",)), QtmBody("B"))


def test_bodies_that_are_disabled_or_relative_are_marked() -> None:
    body = (
        "<Body><Name>{}</Name><Enabled>{}</Enabled><Data_origin>{}</Data_origin>"
        "<Data_orientation>{}</Data_orientation></Body>"
    )
    bodies = body.format("A", "false", 0, 0) + body.format("B", "true", 1, 0)
    bodies += body.format("C", "True", 0, 2)
    found = parse_settings(f"<QTM_Settings><The_6D>{bodies}</The_6D></QTM_Settings>")
    assert found is not None
    assert found.bodies == (
        QtmBody("A", enabled=False),
        QtmBody("B", relative=True),
        QtmBody("C", fixed=True),
    )


@pytest.mark.parametrize(
    "text",
    [
        "",
        "<QTM_Settings>",
        "<other/>",
        "<!DOCTYPE a [<!ENTITY b 'c'>]><QTM_Settings>&b;</QTM_Settings>",
        "<QTM_Settings>" + " " * (4 << 20) + "</QTM_Settings>",
        "\0",
    ],
    ids=["empty", "open", "other root", "entity", "huge", "nul"],
)
def test_other_documents_are_refused(text: str) -> None:
    assert parse_settings(text) is None


@given(st.text("<>/QTMSettings_Verady6DBob 1='\"&#;\n\0ü", max_size=200))
def test_random_text_never_raises(text: str) -> None:
    parse_settings(text)
    parse_settings(f"<QTM_Settings>{text}</QTM_Settings>")
