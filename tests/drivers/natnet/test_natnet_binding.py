"""Assignment of the names in rig.toml to the ids in NatNet frames."""

from __future__ import annotations

import numpy as np
import pytest

from jointfit_protocols.natnet import (
    MarkerSet,
    MarkerSetDescription,
    ModelDefinition,
    SkeletonDescription,
)
from jointfit_protocols.natnet._frame import Skeleton
from tests.drivers.natnet.feeder import (
    INFO,
    MODEL,
    SHANK,
    THIGH,
    Feeder,
    body,
    described,
    frame,
    marker,
    ready,
    told,
)


def test_columns_are_named_and_their_order_does_not_depend_on_ids() -> None:
    got = ready().frame(frame(1, markers=(marker(2 << 16 | 1, (1.0, 0.0, 0.0)),)))
    assert got.layout.markers == ("T1", "T2", "T3", "S1", "S2")
    assert got.layout.bodies == ("Thigh", "Shank")
    assert np.isfinite(got.markers[:, 0]).tolist() == [False, False, False, True, False]


@pytest.mark.parametrize("spelling", ["T2", "Thigh/T2", "Thigh:T2", "Thigh_T2", "Thigh_2"])
def test_a_marker_may_be_written_in_every_way_people_write_it(spelling: str) -> None:
    feeder = ready(markers={"thigh": [spelling]})
    assert not told(feeder.events, "warning")
    got = feeder.frame(frame(1, markers=(marker(65538, (1.0, 2.0, 3.0)),)))
    assert got.markers[got.layout.markers.index(spelling)].tolist() == [1.0, 2.0, 3.0]


def test_a_name_that_two_bodies_have_must_be_written_with_its_body() -> None:
    model = ModelDefinition(
        (described("A", 1, "M", named=True), described("B", 2, "M", named=True))
    )
    feeder = Feeder(version=(4, 0), markers={"thigh": ["M", "B/M"]})
    feeder(INFO._replace(natnet_version=(4, 0, 0, 0)), model)
    (warning,) = told(feeder.events, "warning")
    assert "'M' (mocap.markers.thigh) is ambiguous: write 'A/M' or 'B/M'" in warning.text
    got = feeder.frame(frame(1, markers=(marker(2 << 16 | 1, (1.0, 2.0, 3.0)),)))
    assert got.layout.markers == ("B/M", "A/M")
    assert got.markers[0].tolist() == [1.0, 2.0, 3.0]


def test_unknown_names_are_reported_together_with_suggestions() -> None:
    feeder = ready(
        markers={"thigh": ["T1", "T9", "Q"]}, rigid_body={"shank": "Shink"}, plate="Plate"
    )
    markers, bodies = told(feeder.events, "warning")
    assert "'T9' (mocap.markers.thigh) is not in the stream; did you mean 'T" in markers.text
    assert "'Q' (mocap.markers.thigh) is not in the stream" in markers.text
    assert "The server has: S1, S2, T1, T2, T3" in markers.text
    assert (
        "'Shink' (mocap.rigid_body.shank) is not in the stream; did you mean 'Shank'?"
        in bodies.text
    )
    assert "'Plate' (mocap.plate)" in bodies.text
    assert set(markers.data["unknown"]) == {"T9", "Q", "Shink", "Plate"}  # type: ignore[call-overload]


def test_no_marker_is_suggested_for_two_names() -> None:
    """T3 is the nearest marker of both unknown names, Tt3 and T33."""
    feeder = ready(markers={"thigh": ["T1", "T2", "Tt3"], "shank": ["S1", "S2", "T33"]})
    (warning,) = told(feeder.events, "warning")
    assert "'Tt3' (mocap.markers.thigh) is not in the stream; did you mean 'T3'? " in warning.text
    assert warning.text.count("'T3'") == 1


def test_a_marker_in_use_is_not_suggested_for_another_one() -> None:
    feeder = ready(markers={"thigh": ["T1", "T2", "T3", "T4"]})
    (markers,) = told(feeder.events, "warning")
    assert "'T4' (mocap.markers.thigh) is not in the stream. The server has" in markers.text


def test_marker_names_come_from_the_description_before_the_set_before_a_number() -> None:
    """A marker without a name in the body has its name in the marker set, or else a number."""
    named = described("A", 1, "own", "", named=True)
    model = ModelDefinition((named, MarkerSetDescription("A", ("set1", "set2", "set3"))))
    feeder = Feeder(version=(4, 0))
    feeder(INFO._replace(natnet_version=(4, 0, 0, 0)), model)
    assert feeder.frame(frame(1)).layout.markers == ("own", "set2", "set3")
    plain = Feeder()
    plain(INFO, ModelDefinition((THIGH,)))
    assert plain.frame(frame(1)).layout.markers == ("Marker1", "Marker2", "Marker3")


def test_markers_of_a_set_without_a_body_come_from_the_set_and_zero_is_absent() -> None:
    feeder = Feeder()
    feeder(
        INFO,
        ModelDefinition(
            (MarkerSetDescription("Skin", ("k1", "k2")), MarkerSetDescription("all", ("z",)))
        ),
    )
    got = feeder.frame(
        frame(1, marker_sets=(MarkerSet("Skin", ((1.0, 2.0, 3.0), (0.0, 0.0, 0.0))),))
    )
    assert got.layout.markers == ("k1", "k2")
    assert got.markers[0].tolist() == [1.0, 2.0, 3.0]
    assert np.isnan(got.markers[1]).all()


def test_bones_are_found_by_skeleton_and_bone() -> None:
    bone = described("LThigh", 4)
    feeder = Feeder(rigid_body={"thigh": "Anna/LThigh"})
    feeder(INFO, ModelDefinition((SkeletonDescription("Anna", 3, (bone,)),)))
    sent = body(3 << 16 | 4, (0.0, 0.0, 0.0, 1.0))
    got = feeder.frame(frame(1, skeletons=(Skeleton(3, (sent,)),)))
    assert got.layout.bodies == ("Anna/LThigh",)
    assert got.body_positions[0].tolist() == [1.0, 2.0, 3.0]


def test_two_bodies_with_one_streaming_id_are_both_refused_and_named() -> None:
    feeder = Feeder()
    feeder(INFO, ModelDefinition((THIGH, SHANK._replace(id=1))))
    (warning,) = told(feeder.events, "warning")
    assert "Thigh and Shank" in warning.text
    q = (0.0, 0.0, 0.0, 1.0)
    got = feeder.frame(
        frame(1, bodies=(body(1, q), body(1, q)), markers=(marker(65537, (1.0, 1.0, 1.0)),))
    )
    assert got.layout.bodies == got.layout.markers == ()
    assert feeder.decoder.unknown_ids == 0


def test_a_body_and_a_skeleton_with_one_id_lose_their_markers_only() -> None:
    feeder = Feeder()
    skeleton = SkeletonDescription("Anna", 1, (described("LThigh", 4),))
    feeder(INFO, ModelDefinition((THIGH, skeleton, MarkerSetDescription("Anna", ("A1",)))))
    (warning,) = told(feeder.events, "warning")
    assert "Thigh and Anna" in warning.text
    got = feeder.frame(frame(1))
    assert got.layout.bodies == ("Thigh", "LThigh")
    assert got.layout.markers == ()


def test_an_id_that_occurs_twice_in_a_frame_is_absent_twice() -> None:
    """Of two items with the same id, neither is used."""
    q = (0.0, 0.0, 0.0, 1.0)
    for times in (2, 3):
        got = ready().frame(
            frame(
                1, bodies=(body(1, q),) * times, markers=(marker(65537, (1.0, 1.0, 1.0)),) * times
            )
        )
        assert np.isnan(got.body_positions).all()
        assert np.isnan(got.markers).all()


def test_identifiers_outside_the_model_are_dropped_counted_and_reported_once() -> None:
    feeder = ready()
    strange = frame(
        1, markers=(marker(9 << 16 | 1, (1.0, 1.0, 1.0)), marker(77, (1.0, 1.0, 1.0), 18))
    )
    feeder(strange, strange._replace(number=2))
    assert feeder.decoder.unknown_ids == 2  # model 0 is no model, so its marker is not counted
    (warning,) = told(feeder.events, "warning")
    assert "9:1" in warning.text


def test_a_layout_is_shared_until_the_model_changes() -> None:
    feeder = ready()
    first, second = feeder.frame(frame(1)), feeder.frame(frame(2))
    feeder(MODEL)
    third = feeder.frame(frame(3))
    feeder(ModelDefinition((THIGH,)))
    fourth = feeder.frame(frame(4))
    assert first.layout is second.layout is third.layout
    assert fourth.layout.bodies == ("Thigh",)
