"""Decoder of Vicon packets: names, units, axes, absence, state, time and latency."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jointfit_daemon.model import Chunk, DeviceEvent
from jointfit_drivers.vicon import ViconDecoder, ViconSettings
from jointfit_protocols import vicon
from jointfit_protocols.vicon import ObjectId
from tests.drivers.vicon.feeder import (
    PERIOD,
    SHANK,
    THIGH,
    ViconFeeder,
    frame,
    prop,
    ready,
    recon,
    segments,
    static,
)

QUARTER_TURN = (0.0, -1, 0, 1, 0, 0, 0, 0, 1)
"""Matrix of a rotation by +90° about z, row-major."""


def test_positions_are_metres_and_matrices_are_row_major() -> None:
    (got,) = ready().frames(frame(0, segments(1, 100, 200, 300, QUARTER_TURN)))
    assert got.layout.bodies == ("Thigh", "Shank")
    assert got.layout.markers == ("T1", "T2", "S1")
    assert got.body_positions[0].tolist() == pytest.approx([0.1, 0.2, 0.3])
    half = np.sqrt(0.5)
    assert got.body_orientations[0].tolist() == pytest.approx([half, 0, 0, half])
    assert got.number == 0


def test_what_is_not_in_the_packet_is_nan() -> None:
    (got,) = ready().frames(frame(0))
    assert got.markers[0].tolist() == pytest.approx([1e-3, 2e-3, 3e-3])
    assert np.isnan(got.markers[1]).all()
    assert np.isnan(got.body_positions[1]).all()
    assert np.isnan(got.body_orientations[1]).all()


def test_y_up_is_turned_to_z_up() -> None:
    feeder = ready(vicon.StreamInfo(PERIOD), vicon.ApplicationInfo(1), THIGH, SHANK)
    (got,) = feeder.frames(frame(0))
    assert got.body_positions[0].tolist() == pytest.approx([0.1, -0.3, 0.2])
    (other,) = ready(up_axis="y").frames(frame(0))
    assert other.body_positions[0].tolist() == pytest.approx([0.1, -0.3, 0.2])


def test_equal_ids_of_two_subjects_are_not_confused() -> None:
    (got,) = ready().frames(frame(0, segments(2, 7, 0, 0), segments(1, 5, 0, 0)))
    assert got.body_positions[:, 0].tolist() == pytest.approx([0.005, 0.007])


def test_names_remain_bound_when_ids_change() -> None:
    feeder = ready(rigid_body={"thigh": "Thigh"}, markers={"shank": ["S1"]})
    (before,) = feeder.frames(frame(0, segments(1, 5, 0, 0)))
    feeder(static(vicon.StreamInfo(PERIOD), prop(1, "Shank", "S1"), prop(9, "Thigh", "T1")))
    (after,) = feeder.frames(
        frame(1, segments(9, 5, 0, 0), vicon.LabeledRecons((recon(1, 1, 4, 0, 0),)))
    )
    for got in (before, after):
        column = got.layout.bodies.index("Thigh")
        assert got.body_positions[column, 0] == pytest.approx(0.005)
    assert after.markers[after.layout.markers.index("S1"), 0] == pytest.approx(0.004)


def test_names_are_reported_if_the_server_sends_no_subject() -> None:
    feeder = ViconFeeder(rigid_body={"thigh": "Thigh"})
    (got,) = feeder.frames(frame(0))
    assert got.layout.bodies == ()
    assert any("'Thigh' (mocap.rigid_body.thigh)" in text for text in feeder.texts("warning"))


def test_unknown_ids_and_improper_rotations_are_counted() -> None:
    feeder = ready()
    (got,) = feeder.frames(
        frame(0, segments(77, 1, 1, 1), segments(1, 1, 1, 1, (0.0,) * 9),
              vicon.LabeledRecons((recon(1, 66, 1, 1, 1), recon(1, 1, float("nan"), 0, 0))))
    )  # fmt: skip
    assert np.isnan(got.body_positions).all()
    assert np.isnan(got.markers).all()
    assert (feeder.decoder.unknown_ids, feeder.decoder.suspicious) == (2, 1)


def test_light_segments_are_chained_from_the_root() -> None:
    """The pose of a light segment is relative to its parent segment."""
    chain = tuple(
        vicon.SegmentInfo(n - 1, n, name) for n, name in enumerate(("Hip", "Thigh", "Shank"), 1)
    )
    subject = vicon.SubjectInfo(1, "Anna", chain, ())
    feeder = ready(vicon.StreamInfo(PERIOD), subject)
    turn = Rotation.from_rotvec((0.3, -0.2, 0.9))
    local = [vicon.LightSegment(n, 0.0, 0.0, -400.0, 0.3, -0.2, 0.9) for n in (1, 2, 3)]
    (got,) = feeder.frames(frame(0, vicon.LightSegments(1, tuple(local))))
    assert got.layout.bodies == ("Hip", "Thigh", "Shank")
    offset = np.array((0, 0, -0.4))
    expected = offset + turn.apply(offset) + (turn * turn).apply(offset)
    assert got.body_positions[2].tolist() == pytest.approx(expected.tolist(), abs=1e-7)
    whole = Rotation.from_quat(np.roll(got.body_orientations[2], -1))
    assert (whole.inv() * turn**3).magnitude() < 1e-6

    (orphan,) = feeder.frames(frame(1, vicon.LightSegments(1, (local[0], local[2]))))
    assert np.isfinite(orphan.body_positions[0]).all()
    assert np.isnan(orphan.body_positions[2]).all()


def test_a_loop_of_parents_ends() -> None:
    """Two segments that are parents of each other have no pose."""
    chain = (vicon.SegmentInfo(2, 1, "A"), vicon.SegmentInfo(1, 2, "B"))
    feeder = ready(vicon.StreamInfo(PERIOD), vicon.SubjectInfo(1, "Anna", chain, ()))
    local = tuple(vicon.LightSegment(n, 0.0, 0, 0, 0, 0, 0) for n in (1, 2))
    (got,) = feeder.frames(frame(0, vicon.LightSegments(1, local)))
    assert np.isnan(got.body_positions).all()


# --- state over packets ---------------------------------------------------------------------------


def test_a_packet_without_static_objects_leaves_the_subjects() -> None:
    feeder = ready()
    without = vicon.encode(vicon.FrameInfo(1), vicon.HardwareFrame(1), segments(1, 1, 0, 0))
    (got,) = feeder.frames(without)
    assert got.layout.bodies == ("Thigh", "Shank")


def test_static_types_that_are_neither_present_nor_unchanged_are_cleared() -> None:
    """A packet lists the types of static objects that are unchanged."""
    feeder = ready()
    feeder(vicon.encode(vicon.StreamInfo(PERIOD), vicon.Contents((), frozenset())))
    (got,) = feeder.frames(frame(1))
    assert got.layout.bodies == ()
    again = ready()
    again(vicon.encode(vicon.StreamInfo(PERIOD), vicon.Contents((), frozenset((2,)))))
    assert again.frames(frame(1))[0].layout.bodies == ("Thigh", "Shank")


def test_poses_that_are_listed_as_unchanged_stay() -> None:
    feeder = ready()
    feeder.frames(frame(1, segments(1, 9, 0, 0)))
    unchanged = frozenset((ObjectId.GLOBAL_SEGMENTS,))
    repeated = vicon.encode(
        vicon.FrameInfo(2), vicon.HardwareFrame(2000), vicon.Contents((), unchanged)
    )
    (got,) = feeder.frames(repeated)
    assert got.body_positions[0, 0] == pytest.approx(0.009)
    (gone,) = feeder.frames(frame(3, vicon.LabeledRecons(())))
    assert np.isnan(gone.body_positions).all()


# --- time -----------------------------------------------------------------------------------------


def test_device_time_is_the_frame_of_the_cameras() -> None:
    """The device time is the frame number of the cameras times the frame period."""
    feeder = ready()
    one, two = feeder.frames(frame(0, hardware=5000), frame(1, hardware=5002))
    assert feeder.decoder.tick_clock is not None
    assert feeder.decoder.tick_clock.ticks_per_s == 135_000_000
    assert (one.ticks, two.ticks) == (5000 * PERIOD, 5002 * PERIOD)


@pytest.mark.parametrize("period", [0, -5, 2**62])
def test_an_impossible_period_is_no_clock(period: int) -> None:
    feeder = ready(vicon.StreamInfo(period), THIGH)
    (got,) = feeder.frames(frame(0))
    assert got.ticks is None
    assert feeder.decoder.tick_clock is None


def test_a_falling_number_is_a_restart_and_a_change_of_the_rate_too() -> None:
    feeder = ready()
    feeder.frames(frame(500), frame(501), frame(0))
    assert feeder.texts("restart") == ["frame numbers restarted at 0"]
    feeder(static(vicon.StreamInfo(2 * PERIOD), THIGH, SHANK))
    assert feeder.texts("restart")[1:] == ["the frame rate changed"]


def test_arrivals_are_back_dated_by_the_announced_delay() -> None:
    feeder = ready()
    latency = vicon.LatencyInfo((("a", 0.003), ("b", 0.001)))
    feeder(vicon.encode(vicon.ViconPing(10**9 - 2_000_000)), t_ns=10**9)
    (got,) = feeder.frames(frame(0, latency), t_ns=2 * 10**9)
    assert got.arrival_ns == 2 * 10**9 - 4_000_000 - 1_000_000
    for number in range(1, 120):
        feeder.frames(frame(number, latency), t_ns=2 * 10**9 + number * 10_000_000)
    (info,) = [e for e in feeder.events if isinstance(e, DeviceEvent) and "delay_ms" in e.data]
    assert info.data["delay_ms"] == pytest.approx(5.0)
    assert info.data["delay_sd_ms"] == pytest.approx(1.0)


@pytest.mark.parametrize("seconds", [float("nan"), -1.0, 1e9])
def test_an_implausible_latency_or_ping_is_ignored(seconds: float) -> None:
    feeder = ready()
    feeder(vicon.encode(vicon.ViconPing(7), vicon.ViconPing(2**63)), t_ns=5 * 10**9)
    (got,) = feeder.frames(frame(0, vicon.LatencyInfo((("a", seconds),))), t_ns=5 * 10**9)
    assert got.arrival_ns == 5 * 10**9


def test_a_server_without_latency_is_reported() -> None:
    feeder = ready()
    feeder.frames(*(frame(n) for n in range(120)))
    assert any("announces no latency" in text for text in feeder.texts("warning"))


def test_poor_quality_is_reported_once_by_name() -> None:
    feeder = ready()
    for quality in (0.1, 0.05, 0.9):
        changed = (vicon.StreamInfo(PERIOD), THIGH, SHANK, vicon.ObjectQuality(2, quality))
        feeder(static(*changed))
    assert feeder.texts("warning") == ["quality of 'Shank' is below 0.2"]
    assert feeder.texts("setting") == ["quality of 'Shank' is sufficient again"]


@given(st.lists(st.binary(max_size=120), max_size=6))
def test_random_packets_never_raise(packets: list[bytes]) -> None:
    decoder = ViconDecoder(ViconSettings(driver="vicon", server="x"))
    for packet in packets:
        decoder.feed(Chunk(0, packet))


@given(st.data())
def test_damaged_packets_never_raise(data: st.DataObject) -> None:
    feeder = ViconFeeder()
    for packet in (static(), frame(1), frame(2)):
        changed = bytearray(packet)
        for _ in range(data.draw(st.integers(0, 4))):
            changed[data.draw(st.integers(8, len(packet) - 1))] = data.draw(st.integers(0, 255))
        feeder(bytes(changed))
