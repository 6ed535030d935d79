"""The decoder of the NatNet driver: names, poses, time, and faults."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jointfit_daemon.files.captures import read_capture
from jointfit_daemon.model import (
    Chunk,
    ClockEcho,
    Corrupt,
    DeviceEvent,
    MocapFrame,
    TickClock,
)
from jointfit_drivers.natnet import NatNetDecoder, NatNetSettings
from jointfit_protocols.natnet import (
    FRAME_EDIT_MODE,
    FRAME_MODEL_CHANGED,
    Bare,
    Body,
    CommandRequest,
    CommandResponse,
    EchoRequest,
    EchoResponse,
    FrameOfData,
    ModelDefinition,
    NatNetMessageId,
)
from tests.drivers.natnet.feeder import (
    INFO,
    MODEL,
    Feeder,
    body,
    described,
    frame,
    marker,
    ready,
    told,
)

if TYPE_CHECKING:
    from pathlib import Path

# --- occlusion --------------------------------------------------------------------------------


@pytest.mark.parametrize("params", [11, 8, 9, 12, 4])
def test_an_occluded_or_unsolved_marker_is_absent_whatever_its_position(params: int) -> None:
    got = ready().frame(frame(1, markers=(marker(65537, (1.0, 2.0, 3.0), params),)))
    assert np.isnan(got.markers).all()


def test_an_untracked_body_is_absent_though_its_last_pose_is_repeated() -> None:
    q = (0.0, 0.0, 0.0, 1.0)
    got = ready().frame(frame(1, bodies=(body(1, q, 0), body(2, q, 1))))
    assert np.isnan(got.body_positions[0]).all()
    assert np.isnan(got.body_orientations[0]).all()
    assert got.body_positions[1].tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    "q", [(0.0, 0.0, 0.0, 1.01), (0.0, 0.0, 0.0, 0.0), (float("nan"), 0.0, 0.0, 1.0)]
)
def test_a_rotation_that_is_none_is_absent_and_counted(
    q: tuple[float, float, float, float],
) -> None:
    """A quaternion whose norm is not 1 is no rotation."""
    feeder = ready()
    got = feeder.frame(frame(1, bodies=(body(1, q),)))
    assert np.isnan(got.body_orientations).all()
    assert feeder.decoder.suspicious == 1


def test_a_position_that_is_not_finite_is_absent() -> None:
    got = ready().frame(frame(1, markers=(marker(65537, (float("inf"), 0.0, 0.0)),)))
    assert np.isnan(got.markers).all()


def test_residuals_of_the_cameras_are_unknown_for_markers_that_are_not_usable() -> None:
    seen = marker(65537, (1.0, 2.0, 3.0))._replace(residual=2e-4)
    hidden = marker(65538, (1.0, 2.0, 3.0), 11)._replace(residual=2e-4)
    got = ready().frame(frame(1, markers=(seen, hidden)))
    assert got.residuals is not None
    usable = np.isfinite(got.markers[:, 0])
    assert np.isfinite(got.residuals).tolist() == usable.tolist()
    assert got.residuals[usable].tolist() == pytest.approx([2e-4])


def test_the_real_occluded_frame_has_three_markers_of_five(shared_data: Path) -> None:
    folder = shared_data / "mocap" / "natnet_v3_mje-nz" / "test_data"
    feeder = Feeder(up_axis="y")
    tree = described("FakeTree", 7, "a", "b", "c", "d", "e")
    feeder(INFO, ModelDefinition((tree,)))
    (chunk,) = read_capture(folder / "mocapframe_packet_occluded_v3.bin", "datagram")
    (got,) = feeder.decoder.feed(chunk)
    assert isinstance(got, MocapFrame)
    assert np.isfinite(got.markers).all(axis=1).tolist() == [False, False, True, True, True]
    assert np.isfinite(got.body_positions).all()
    assert got.ticks == 8642283567331


# --- axes -------------------------------------------------------------------------------------


@given(
    st.sampled_from("xyz"),
    st.tuples(*[st.floats(-4, 4, width=32)] * 3),
    st.integers(0, 2**32 - 1),
)
def test_the_world_is_turned_so_that_up_is_z_and_bodies_keep_their_axes(
    up: str, at: tuple[float, float, float], seed: int
) -> None:
    turn = {
        "x": Rotation.from_euler("y", -90, degrees=True),
        "y": Rotation.from_euler("x", 90, degrees=True),
        "z": Rotation.identity(),
    }[up]
    q = Rotation.random(random_state=seed)
    x, y, z, w = q.as_quat()
    wire = (Body(1, *at, x, y, z, w, 0.0, 1),)
    got = ready(up_axis=up).frame(frame(1, markers=(marker(65537, at),), bodies=wire))
    assert turn.apply(np.eye(3)["xyz".index(up)]) == pytest.approx([0, 0, 1], abs=1e-12)
    assert got.markers[0] == pytest.approx(turn.apply(at), abs=1e-9)
    assert got.body_positions[0] == pytest.approx(turn.apply(at), abs=1e-9)
    w, x, y, z = got.body_orientations[0]
    assert (Rotation.from_quat([x, y, z, w]).inv() * turn * q).magnitude() < 1e-6
    assert np.linalg.norm(got.body_orientations[0]) == pytest.approx(1, abs=1e-12)


# --- time and order ---------------------------------------------------------------------------


def test_ticks_are_the_exposure_and_the_clock_is_the_servers() -> None:
    """The time of a frame is the exposure of its images, in ticks of the server clock."""
    assert Feeder().decoder.tick_clock is None
    feeder = ready()
    assert feeder.decoder.tick_clock == TickClock(0, None, 10_000_000)
    assert feeder.frame(frame(5, ticks=123456789)).ticks == 123456789


def test_without_exposure_stamps_the_configured_latency_is_used_and_reported_once() -> None:
    """The latency from exposure to a later stamp of the server is subtracted from this stamp."""
    feeder = ready(latency_ms=8.0)
    got = [feeder.frame(frame(n, exposure=0, ticks=10**6 + n)) for n in (1, 2)]
    assert got[0].ticks == 10**6 + 1 + 2 - 80_000
    assert len(told(feeder.events, "warning")) == 1


def test_echo_yields_both_host_stamps_and_foreign_echoes_are_ignored() -> None:
    """An echo is the answer of the server to a request, with the host time of the request."""
    feeder = ready()
    events = feeder(EchoResponse(1_000, 77), t_ns=500_000)
    assert events == [ClockEcho(1_000, 500_000, 77)]
    assert not feeder(EchoResponse(1_000, 77), t_ns=1_000 + 10**9 + 1)
    assert not feeder(EchoResponse(2_000, 77), t_ns=1_000)


def test_a_recorded_echo_request_lends_its_arrival_to_the_answer() -> None:
    """In a capture, the packet time of the request replaces the host time in the answer."""
    feeder = ready()
    assert not feeder(EchoRequest(42), t_ns=5_000)
    assert feeder(EchoResponse(42, 9), t_ns=6_000) == [ClockEcho(5_000, 6_000, 9)]


def test_gaps_are_counted_repeats_and_overtaken_frames_dropped() -> None:
    """An overtaken frame is one that arrives after a later frame."""
    feeder = ready()
    feeder(*(frame(n) for n in (1, 2, 5, 5, 4, 6)))
    assert [e.number for e in feeder.events if isinstance(e, MocapFrame)] == [1, 2, 5, 6]
    assert [e.data["lost"] for e in told(feeder.events, "gap")] == [2]
    assert (feeder.decoder.duplicates, feeder.decoder.late) == (1, 1)


@pytest.mark.parametrize("after", [frame(3), frame(1001, ticks=5)])
def test_a_falling_number_or_clock_is_a_restart(after: FrameOfData) -> None:
    feeder = ready()
    feeder(frame(1000))
    assert len(told(feeder(after), "restart")) == 1
    assert isinstance(feeder.events[-1], MocapFrame)


def test_loop_of_a_short_recording_is_a_restart() -> None:
    feeder = ready()
    feeder(*(frame(n % 40) for n in range(200)))
    assert len(told(feeder.events, "restart")) == 4


def test_another_server_in_its_place_is_a_restart_without_names() -> None:
    """After the restart, the names of markers and bodies are unknown until the next description."""
    feeder = ready()
    out = feeder(INFO._replace(clock_hz=3_312_787), frame(1))
    assert len(told(out, "restart")) == 1
    assert feeder.decoder.unpublished == 1
    assert feeder(INFO._replace(clock_hz=3_312_787)) == []


# --- announcements of the server --------------------------------------------------------------


def test_frames_before_the_model_are_counted_and_not_published() -> None:
    feeder = Feeder()
    assert feeder(frame(1)) == []
    feeder(INFO)
    assert feeder(frame(2)) == []
    assert feeder.decoder.unpublished == 2
    (info,) = told(feeder(MODEL), "info")
    assert info.data["unpublished"] == 2
    assert isinstance(feeder(frame(3))[0], MocapFrame)


def test_edit_mode_is_reported_at_begin_and_end_and_its_frames_are_not_live() -> None:
    """In edit mode, the camera software plays recorded data."""
    feeder = ready()
    got = [feeder.frame(frame(n, params=p)) for n, p in ((1, 0), (2, 4), (3, 4), (4, 0))]
    assert [one.live for one in got] == [True, False, False, True]
    assert [e.data["live"] for e in told(feeder.events, "setting")] == [False, True]
    assert FRAME_EDIT_MODE == 4


def test_a_changed_model_is_announced_once() -> None:
    feeder = ready()
    feeder(*(frame(n, params=FRAME_MODEL_CHANGED) for n in (1, 2, 3)))
    assert len(told(feeder.events, "setting")) == 1


def test_the_bitstream_follows_the_response_and_the_frames_stay_readable() -> None:
    """The response announces another bitstream, which the next frames have."""
    feeder = ready()
    assert feeder(CommandResponse(b"Bitstream,4.1\0")) == []
    feeder.version = (4, 1)
    setting, first = feeder(frame(1))
    assert isinstance(setting, DeviceEvent)
    assert (setting.kind, setting.data["bitstream"]) == ("setting", "4.1")
    assert isinstance(first, MocapFrame)


def test_frames_in_the_requested_bitstream_are_decoded_without_confirmation() -> None:
    """The driver requested bitstream 4.1, and the response was lost."""
    feeder = ready(bitstream="4.1")
    feeder.version = (4, 1)
    out = feeder(frame(1, markers=(marker(65537, (1.0, 2.0, 3.0)),)))
    assert [type(event) for event in out] == [DeviceEvent, MocapFrame]


def test_a_server_before_bitstream_2_5_is_refused_by_name() -> None:
    feeder = Feeder()
    (error,) = told(feeder(INFO._replace(natnet_version=(2, 4, 0, 0), clock_hz=None)), "error")
    assert "2.4" in error.text
    assert isinstance(feeder(frame(1))[0], Corrupt)


@pytest.mark.parametrize("version", [(2, 5), (2, 6), (2, 7), (2, 9), (2, 11)])
def test_frames_of_bitstream_2_have_no_device_time(version: tuple[int, int]) -> None:
    feeder = Feeder(version=version)
    feeder(INFO._replace(natnet_version=(*version, 0, 0), clock_hz=None), MODEL)
    seen = feeder.frame(
        frame(7, markers=(marker(65537, (1.0, 2.0, 3.0)),), bodies=(body(1, (0, 0, 0.6, 0.8)),))
    )
    assert (seen.number, seen.ticks, feeder.decoder.tick_clock) == (7, None, None)
    assert seen.markers[seen.layout.markers.index("T1")].tolist() == [1.0, 2.0, 3.0]
    assert seen.body_positions[seen.layout.bodies.index("Thigh")].tolist() == [1.0, 2.0, 3.0]


def test_messages_of_clients_are_ignored() -> None:
    feeder = ready()
    before = feeder.decoder.messages
    assert (
        feeder(
            Bare(NatNetMessageId.KEEPALIVE),
            CommandRequest("FrameRate"),
            Bare(NatNetMessageId.DISCONNECT),
        )
        == []
    )
    assert feeder.decoder.messages == before + 3


@given(st.binary(max_size=80))
def test_a_datagram_is_a_message_or_counted_lost(data: bytes) -> None:
    decoder = ready().decoder
    before = decoder.messages
    lost = sum(e.discarded for e in decoder.feed(Chunk(0, data)) if isinstance(e, Corrupt))
    assert lost == decoder.discarded_bytes
    assert (lost == len(data)) != (decoder.messages == before + 1) or not data


# --- the real capture -------------------------------------------------------------------------


def test_the_real_capture_decodes_whole_from_itself_alone(shared_data: Path) -> None:
    """The capture contains the descriptions that its frames need."""
    path = shared_data / "mocap" / "natnet_v3_mje-nz" / "test_data" / "raw" / "traffic.pcapng"
    decoder = NatNetDecoder(NatNetSettings(driver="natnet", server="x", up_axis="z"))
    events = [event for chunk in read_capture(path, "datagram") for event in decoder.feed(chunk)]
    frames = [event for event in events if isinstance(event, MocapFrame)]
    echoes = [event for event in events if isinstance(event, ClockEcho)]
    assert (decoder.messages, decoder.discarded_bytes) == (550, 0)
    assert len(frames) + decoder.unpublished == 518
    assert frames[-1].number == 163251
    assert frames[-1].ticks == 1416512003288
    assert frames[-1].layout.markers == tuple(f"Marker{i}" for i in range(1, 6))
    assert all(np.isfinite(one.markers).all() for one in frames)
    mean = np.mean([one.body_positions[0] for one in frames], axis=0)
    assert mean == pytest.approx([0.1744416, 1.4471301, -0.7343158], abs=2e-6)
    trips_us = [(echo.received_ns - echo.sent_ns) // 1000 for echo in echoes]
    assert trips_us == [1156, 918, 897, 936, 1060, 948, 927, 868, 900]
    assert not told(events, "warning")
    assert not told(events, "gap")
