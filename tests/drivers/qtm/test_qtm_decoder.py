"""Decoder of QTM packets: names, units, axes, absence, time and order."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.model import Chunk, MocapFrame
from jointfit_drivers.qtm import QtmDecoder, QtmSettings
from jointfit_protocols import qtm
from jointfit_protocols.qtm import ComponentType, QtmEvent
from tests.drivers.qtm.feeder import (
    HIDDEN,
    MISSING,
    THREE,
    TWO,
    QtmFeeder,
    bodies,
    body,
    camera_time,
    frame,
    markers,
    ready,
    xml,
)

QUARTER_TURN = (0.0, 1, 0, -1, 0, 0, 0, 0, 1)
"""Matrix of a rotation by +90° about z, column-major."""


def test_positions_are_metres_and_matrices_are_column_major() -> None:
    (got,) = ready().frames(frame(1, bodies(body(100, 200, 300, QUARTER_TURN), MISSING), THREE,
                                  camera_time(7)))  # fmt: skip
    assert got.layout.markers == ("T1", "T2", "T3")
    assert got.layout.bodies == ("Thigh", "Shank")
    assert got.body_positions[0].tolist() == pytest.approx([0.1, 0.2, 0.3])
    half = np.sqrt(0.5)
    assert got.body_orientations[0].tolist() == pytest.approx([half, 0, 0, half])
    assert got.markers[2].tolist() == pytest.approx([1e-3, 2e-3, 3e-3])


def test_what_the_cameras_do_not_see_is_nan() -> None:
    (got,) = ready().frames(frame(1))
    assert np.isnan(got.markers[1]).all()
    assert np.isnan(got.body_positions[1]).all()
    assert np.isnan(got.body_orientations[1]).all()
    (got,) = ready().frames(
        frame(1, bodies((float("inf"), *body(0, 2, 3)[1:]), MISSING),
              markers((1, 2, 3e9, 0), HIDDEN, HIDDEN), camera_time(7))
    )  # fmt: skip
    assert np.isnan(got.markers).all()
    assert np.isnan(got.body_positions).all()


def test_residuals_of_the_cameras_are_metres_and_unknown_where_zero_or_missing() -> None:
    (got,) = ready().frames(
        frame(1, bodies(MISSING, MISSING), markers((1, 2, 3, 0.5), HIDDEN, (4, 5, 6, 0.0)),
              camera_time(7))
    )  # fmt: skip
    assert got.residuals is not None
    assert got.residuals[0] == pytest.approx(0.5e-3)
    assert np.isnan(got.residuals[1:]).all()


def test_a_matrix_that_is_no_rotation_is_absent_and_counted() -> None:
    feeder = ready()
    (got,) = feeder.frames(frame(1, bodies(body(1, 2, 3, (0.0,) * 9), MISSING), THREE,
                                 camera_time(7)))  # fmt: skip
    assert np.isnan(got.body_orientations).all()
    assert feeder.decoder.suspicious == 1


@pytest.mark.parametrize(
    ("announced", "configured", "expected"),
    [("+Y", "auto", (0.1, -0.3, 0.2)), ("-Z", "auto", (0.1, -0.2, -0.3)),
     ("+Z", "y", (0.1, -0.3, 0.2))],
)  # fmt: skip
def test_the_announced_vertical_axis_becomes_z(
    announced: str, configured: str, expected: tuple[float, ...]
) -> None:
    (got,) = ready(settings=xml(up=announced), up_axis=configured).frames(frame(1))
    assert got.markers[0].tolist() == pytest.approx(expected)
    assert got.body_positions[0].tolist() == pytest.approx(expected)


def test_columns_follow_the_names_after_the_operator_has_reordered_them() -> None:
    feeder = ready(markers={"thigh": ["T3", "T1"]}, rigid_body={"shank": "Shank"})
    (before,) = feeder.frames(frame(1))
    feeder(qtm.SettingsReply(xml(labels=("T3", "T2", "T1"), bodies=("Shank", "Thigh"))))
    (after,) = feeder.frames(frame(2))
    column = after.layout.markers.index("T1")
    assert after.markers[column].tolist() == pytest.approx([1e-3, 2e-3, 3e-3])
    assert before.layout.bodies[0] == after.layout.bodies[0] == "Shank"
    assert np.isnan(before.body_positions[0]).all()
    assert np.isfinite(after.body_positions[0]).all()


def test_frames_that_do_not_fit_the_settings_are_dropped_and_counted() -> None:
    feeder = ready()
    assert feeder.frames(frame(1, TWO, markers(HIDDEN), camera_time(1))) == []
    assert feeder.frames(frame(2, bodies(MISSING), THREE, camera_time(2))) == []
    assert feeder.decoder.unpublished == 2
    assert sum("do not fit" in text for text in feeder.texts("warning")) == 1
    assert len(feeder.frames(frame(3))) == 1


def test_only_enabled_bodies_may_be_in_a_frame() -> None:
    feeder = ready(settings=xml(bodies=("OffPlate", "Thigh")))
    (got,) = feeder.frames(frame(1, bodies(body(1000, 0, 0)), THREE, camera_time(1)))
    assert got.body_positions[got.layout.bodies.index("Thigh")].tolist() == [1, 0, 0]
    assert np.isnan(got.body_positions[got.layout.bodies.index("OffPlate")]).all()


@pytest.mark.parametrize("origin", [1, 2])
def test_a_body_in_other_than_world_coordinates_is_refused_by_name(origin: int) -> None:
    feeder = ready(settings=xml(origins=(0, origin)))
    (got,) = feeder.frames(frame(1))
    assert got.layout.bodies == ("Thigh",)
    assert any("'Shank' is relative" in text for text in feeder.texts("warning"))


def test_unknown_names_are_reported_with_a_suggestion() -> None:
    feeder = ready(markers={"thigh": ["T1", "T9"]}, rigid_body={"thigh": "Tigh"})
    text = " ".join(feeder.texts("warning"))
    assert "'T9' (mocap.markers.thigh) is not in the stream" in text
    assert "did you mean 'Thigh'?" in text


def test_segments_of_skeletons_are_bodies() -> None:
    described = xml().replace(
        "</QTM_Par",
        '<Skeletons><Skeleton Name="Anna"><Segments><Segment Name="Hip" ID="4"/></Segments>'
        "</Skeleton></Skeletons></QTM_Par",
    )
    feeder = ready(settings=described, skeleton=True, rigid_body={"thigh": "Anna/Hip"})
    segment = qtm.SkeletonSegment(4, 100.0, 0, 0, 0, 0, 0.6, 0.8)
    parts = (TWO, THREE, camera_time(1), qtm.SkeletonComponent(((segment,),)))
    (got,) = feeder.frames(frame(1, *parts))
    assert got.layout.bodies[0] == "Anna/Hip"
    assert got.body_orientations[0].tolist() == pytest.approx([0.8, 0, 0, 0.6])
    (gone,) = feeder.frames(frame(2, TWO, THREE, camera_time(2), qtm.SkeletonComponent(((),))))
    assert np.isnan(gone.body_positions[0]).all()


# --- time -----------------------------------------------------------------------------------------


def test_camera_time_is_the_clock_if_it_is_streamed() -> None:
    feeder = ready()
    (got,) = feeder.frames(frame(1, TWO, THREE, camera_time(0x1_0000_0002)))
    assert got.ticks == 0x1_0000_0002
    assert feeder.decoder.tick_clock is not None
    assert feeder.decoder.tick_clock.tick_ns == 100
    assert not [text for text in feeder.texts("warning") if "camera time" in text]


def test_without_camera_time_the_measurement_is_the_clock_and_the_setting_is_named() -> None:
    """The device time is then the time since the start of the measurement."""
    feeder = ready(settings=xml(stamp=None))
    (got,) = feeder.frames(frame(5, TWO, THREE))
    assert got.ticks == 50_000
    assert feeder.decoder.tick_clock is not None
    assert feeder.decoder.tick_clock.tick_ns == 1000
    assert any("select camera time" in text for text in feeder.texts("warning"))


def test_the_clocks_are_not_mixed_and_a_change_restarts_the_clock() -> None:
    feeder = ready()
    feeder.frames(frame(1))
    (without,) = feeder.frames(frame(2, TWO, THREE, qtm.TimecodeComponent(())), frame(3))[:1]
    assert without.ticks is None
    feeder(qtm.SettingsReply(xml(stamp=None)))
    (other,) = feeder.frames(frame(4, TWO, THREE))
    assert other.ticks == 40_000
    assert any("another clock" in text for text in feeder.texts("restart"))


def test_a_stamp_that_no_clock_has_is_left_out() -> None:
    feeder = ready()
    (got,) = feeder.frames(frame(1, TWO, THREE, camera_time(2**63)))
    assert got.ticks is None
    assert feeder.decoder.suspicious == 1


def test_smpte_timecode_is_reported_once() -> None:
    feeder = ready(settings=xml(stamp="SMPTE"))
    code = qtm.TimecodeComponent((qtm.QtmTimecode(0, 0, 1 | 2 << 5 | 3 << 11 | 4 << 17),))
    (got, _) = feeder.frames(frame(1, TWO, THREE, code), frame(2, TWO, THREE, code))
    assert got.ticks == 10_000
    assert feeder.texts("info").count("timecode 01:02:03:04") == 1


# --- order and playback ---------------------------------------------------------------------------


def test_repeated_and_reordered_frames_are_dropped_and_counted() -> None:
    feeder = ready()
    got = feeder.frames(frame(1), frame(3), frame(2), frame(3), frame(4))
    assert [one.number for one in got] == [1, 3, 4]
    assert (feeder.decoder.duplicates, feeder.decoder.late) == (1, 1)


def test_a_loop_of_a_recording_is_a_restart() -> None:
    feeder = ready(settings=xml(stamp=None))
    got = feeder.frames(*(frame(n, TWO, THREE) for n in (100, 101, 1, 2)))
    assert [one.number for one in got] == [100, 101, 1, 2]
    assert feeder.texts("restart") == ["time stamps restarted"]


def test_numbers_that_stand_still_are_no_repetition() -> None:
    """If the frame number is constant, frames are numbered by their time."""
    feeder = ready()
    got = feeder.frames(*(frame(1, us=us) for us in (10_000, 20_000, 30_000, 60_000)))
    assert [one.number for one in got] == [1, 2, 3, 6]
    assert feeder.texts("gap") == []


def test_losses_are_counted_in_units_of_the_usual_step() -> None:
    """Here, the frame number usually increases by two."""
    feeder = ready()
    feeder.frames(*(frame(n) for n in (2, 4, 6, 8, 14, 16)))
    assert feeder.texts("gap") == ["2 frames lost"]


def test_a_frame_in_several_datagrams_is_one_frame() -> None:
    feeder = ready()
    parts = [frame(1, TWO), frame(1, THREE), frame(1, camera_time(5))]
    first, second = [feeder.frames(part, t_ns=n) for n, part in enumerate(parts[:2], 10)]
    (got,) = feeder.frames(parts[2], t_ns=12)
    assert (first, second, got.arrival_ns, got.ticks) == ([], [], 10, 5)
    assert np.isfinite(got.markers[0]).all()
    assert np.isfinite(got.body_positions[0]).all()


def test_a_part_that_is_lost_costs_only_its_content() -> None:
    """QTM may send the parts of a frame in separate datagrams."""
    feeder = ready()
    assert feeder.frames(frame(1, TWO), frame(1, camera_time(5))) == []
    one, two = feeder.frames(frame(2))
    assert (one.number, two.number) == (1, 2)
    assert np.isnan(one.markers).all()


def test_a_component_that_never_arrives_is_named_and_not_waited_for() -> None:
    feeder = ready()
    got = feeder.frames(*(frame(n, THREE, camera_time(n)) for n in range(1, 30)))
    assert len(got) == 29
    assert sum("no 6DOF bodies" in text for text in feeder.texts("warning")) == 1


def test_playback_is_not_live() -> None:
    feeder = ready()
    feeder(qtm.Event(QtmEvent.RT_FROM_FILE_STARTED))
    (recorded,) = feeder.frames(frame(1))
    feeder(qtm.Event(QtmEvent.RT_FROM_FILE_STOPPED))
    (live,) = feeder.frames(frame(2))
    assert (recorded.live, live.live) == (False, True)


def test_waiting_for_a_measurement_is_reported_once() -> None:
    feeder = ready()
    feeder(qtm.NoMoreData(), qtm.NoMoreData())
    assert len([text for text in feeder.texts("setting") if "waiting" in text]) == 1


@given(st.lists(st.binary(max_size=120), max_size=6))
def test_random_packets_never_raise(packets: list[bytes]) -> None:
    decoder = QtmDecoder(QtmSettings(driver="qtm", server="x"))
    for packet in packets:
        decoder.feed(Chunk(0, packet))
    assert decoder.discarded_bytes <= sum(map(len, packets))


@given(st.data())
def test_damaged_frames_never_raise(data: st.DataObject) -> None:
    feeder = ready()
    packet = bytearray(qtm.encode(frame(1)))
    for _ in range(data.draw(st.integers(1, 4))):
        packet[data.draw(st.integers(8, len(packet) - 1))] = data.draw(st.integers(0, 255))
    for item in feeder.decoder.feed(Chunk(0, bytes(packet))):
        if isinstance(item, MocapFrame):
            assert not np.isinf(item.markers).any()


def test_items_of_every_kind_are_bound_only_by_their_own_component() -> None:
    """Unlabeled markers do not appear as labeled markers."""
    feeder = QtmFeeder()
    feeder(qtm.SettingsReply(xml(labels=(), bodies=())))
    other = qtm.ItemsComponent(ComponentType.UNLABELED, 0, 0, ((1.0, 2.0, 3.0, 7),))
    (got,) = feeder.frames(frame(1, other, camera_time(1)))
    assert got.markers.shape == (0, 3)
