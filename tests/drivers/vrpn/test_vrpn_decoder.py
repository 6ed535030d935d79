"""The VRPN decoder: frames of several bodies, occlusion, names, units, axes and clock steps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.model import Chunk, Corrupt, Decoded, DeviceEvent, MocapFrame
from jointfit_drivers.vrpn import VrpnDecoder, VrpnSettings
from jointfit_protocols import vrpn
from jointfit_protocols.vrpn import SenderDescription, TrackerPose, TypeDescription, encode

PERIOD_US = 10_000
T0_US = 1_700_000_000_000_000
TYPES = {vrpn.POS_QUAT: 4}
NAMES = {1: "Thigh", 2: "Shank", 3: "Foot"}
OPENING = b"".join(
    [
        encode(vrpn.Cookie()),
        encode(TypeDescription(4, vrpn.POS_QUAT)),
        *(encode(SenderDescription(number, name)) for number, name in NAMES.items()),
    ]
)


def report(sender: int, time_us: int, at: tuple[float, float, float] = (1, 2, 3), sensor: int = 0,
           q: tuple[float, float, float, float] = (0, 0, 0.6, 0.8)) -> bytes:  # fmt: skip
    return encode(TrackerPose(time_us, sender, sensor, *at, *q), TYPES)


class Feeder:
    """A decoder with all items that it returned."""

    def __init__(self, **settings: Any) -> None:
        table = {"driver": "vrpn", "server": "x", "up_axis": "z", **settings}
        self.decoder = VrpnDecoder(VrpnSettings.model_validate(table))
        self.items: list[Decoded] = []
        self(OPENING)

    def __call__(self, *data: bytes, t_us: int = T0_US) -> list[Decoded]:
        out = [item for part in data for item in self.decoder.feed(Chunk(t_us * 1000, part))]
        self.items += out
        return out

    def play(self, frames: range, *senders: int, **keys: Any) -> list[MocapFrame]:
        out: list[Decoded] = []
        for number in frames:
            t_us = T0_US + number * PERIOD_US
            for n, sender in enumerate(senders):
                out += self(report(sender, t_us + 20 * n, **keys), t_us=t_us)
        return [item for item in out if isinstance(item, MocapFrame)]

    @property
    def frames(self) -> list[MocapFrame]:
        return [item for item in self.items if isinstance(item, MocapFrame)]

    def events(self, kind: str) -> list[DeviceEvent]:
        found = [item for item in self.items if isinstance(item, DeviceEvent)]
        return [event for event in found if event.kind == kind]


def seen(frame: MocapFrame) -> set[str]:
    present = np.isfinite(frame.body_positions[:, 0])
    return {name for name, is_seen in zip(frame.layout.bodies, present, strict=True) if is_seen}


def test_the_bodies_of_one_instant_are_one_frame() -> None:
    feeder = Feeder()
    frames = feeder.play(range(20), 1, 2, 3)
    assert all(seen(frame) == {"Thigh", "Shank", "Foot"} for frame in frames)
    assert [frame.ticks for frame in frames] == [T0_US + n * PERIOD_US for n in range(20)]
    assert frames[-1].arrival_ns == (T0_US + 19 * PERIOD_US) * 1000  # not delayed by a frame


def test_a_body_without_a_report_is_absent_and_delays_no_frame_for_long() -> None:
    feeder = Feeder()
    feeder.play(range(10), 1, 2)
    hidden = feeder.play(range(10, 40), 1)
    back = feeder.play(range(40, 43), 1, 2)
    assert [seen(frame) for frame in hidden] == [{"Thigh"}] * 30
    assert hidden[0].ticks == T0_US + 10 * PERIOD_US
    assert hidden[-1].arrival_ns == (T0_US + 39 * PERIOD_US) * 1000
    assert [seen(frame) for frame in back] == [{"Thigh"}, *[{"Thigh", "Shank"}] * 2]
    assert feeder.decoder.late_reports == 1  # the frame of its first report had ended


def test_bodies_hidden_in_turns_are_not_merged() -> None:
    """Two bodies that are visible alternately are in separate frames."""
    feeder = Feeder()
    feeder.play(range(10), 1, 2)
    turns = [frame for n in range(10, 20) for frame in feeder.play(range(n, n + 1), 1 + n % 2)]
    assert [seen(frame) for frame in turns] == [{NAMES[1 + n % 2]} for n in range(10, 19)]
    assert [frame.ticks for frame in turns] == [T0_US + n * PERIOD_US for n in range(10, 19)]


def test_a_stall_of_the_server_costs_no_report() -> None:
    """Pauses make the estimated period much longer than the intervals between the other reports."""
    feeder = Feeder()
    t_us = T0_US
    for n in range(60):
        t_us += 50_000 if n % 7 == 0 else 2_000
        feeder(report(1, t_us), t_us=t_us)
    assert len(feeder.frames) == 60
    assert feeder.decoder.late_reports == 0


def test_frames_sent_in_bursts_remain_whole() -> None:
    """A busy server stamps the messages of late frames with nearly the same time."""
    feeder = Feeder()
    t_us = T0_US
    for n in range(300):
        t_us += 24_000 if n % 3 == 0 else 700
        for place, sender in enumerate((1, 2, 3)):
            feeder(report(sender, t_us + 200 * place), t_us=t_us)
    whole = [frame for frame in feeder.frames if len(seen(frame)) == 3]
    assert len(whole) >= 290  # the period is not known at the start
    assert feeder.frames[-290:] == whole[-290:]


@given(st.lists(st.sets(st.sampled_from([1, 2, 3]), min_size=1), min_size=1, max_size=40))
def test_every_report_is_in_one_frame_or_counted(visible: list[set[int]]) -> None:
    feeder = Feeder()
    for number, senders in enumerate(visible):
        feeder.play(range(number, number + 1), *sorted(senders))
    feeder.items += feeder.decoder.flush()
    used = sum(len(seen(frame)) for frame in feeder.frames)
    assert used + feeder.decoder.late_reports == sum(map(len, visible))
    times = [frame.ticks for frame in feeder.frames]
    assert times == sorted(set(times), key=lambda value: value or 0)


def test_one_tracker_has_several_bodies() -> None:
    feeder = Feeder(rigid_body={"thigh": "Thigh#0", "shank": "Thigh#1"})
    t_us = T0_US
    for n in range(30):
        for sensor in (0, 1):
            t_us = T0_US + n * 100_000
            feeder(report(1, t_us, (sensor, n, 0), sensor), t_us=t_us)
    assert feeder.frames[-1].layout.bodies == ("Thigh#0", "Thigh#1")
    assert feeder.frames[-1].body_positions[:, 0].tolist() == [0.0, 1.0]
    assert not feeder.events("warning")


def test_trackers_named_as_markers_are_markers() -> None:
    feeder = Feeder(markers={"thigh": ("Thigh", "Shank", "Foot")})
    frame = feeder.play(range(9), 1, 2, 3, at=(1.0, 2.0, 3.0), q=(0.0, 0.0, 0.0, 0.0))[-1]
    assert frame.layout.markers == ("Thigh", "Shank", "Foot")
    assert frame.layout.bodies == ()
    assert frame.markers.tolist() == [[1.0, 2.0, 3.0]] * 3
    assert feeder.decoder.suspicious == 0


def test_a_name_that_the_server_does_not_have_is_reported_with_the_nearest() -> None:
    feeder = Feeder(rigid_body={"thigh": "Thig", "shank": "Foot"})
    feeder.play(range(40), 1)
    assert not feeder.events("warning")
    feeder.play(range(40, 70), 1)
    (warning,) = feeder.events("warning")
    assert "'Thig'" in warning.text
    assert "did you mean 'Thigh'?" in warning.text
    assert "'Foot'" not in warning.text  # described, but not seen yet


def test_poses_of_senders_without_a_name_are_dropped_and_reported_once() -> None:
    feeder = Feeder()
    feeder.play(range(5), 1, 9)
    assert feeder.decoder.unknown_ids == 5
    (warning,) = feeder.events("warning")
    assert "sender 9" in warning.text
    feeder(encode(SenderDescription(9, "Late")))
    assert "Late" in feeder.play(range(5, 15), 1, 9)[-1].layout.bodies


def test_the_quaternion_is_x_y_z_w_and_the_world_z_up() -> None:
    frame = Feeder(up_axis="y").play(range(5), 1, at=(0.5, 1.0, -0.25), q=(0.0, 0.0, 0.6, 0.8))[-1]
    assert frame.body_positions[0].tolist() == [0.5, 0.25, 1.0]
    half = 0.5**0.5
    # q_x90 q, with q_x90 = (half, half, 0, 0)
    expected = [half * 0.8, half * 0.8, -half * 0.6, half * 0.6]
    np.testing.assert_allclose(frame.body_orientations[0], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("unit", "at", "remedy"),
    [("m", (812.0, 90.0, 3.0), 'set unit = "mm"'), ("mm", (0.812, 0.09, 3.0), 'set unit = "m"')],
)
def test_a_wrong_unit_is_detected(unit: str, at: tuple[float, float, float], remedy: str) -> None:
    feeder = Feeder(unit=unit)
    feeder.play(range(600), 1, at=at)
    (warning,) = feeder.events("warning")
    assert remedy in warning.text


def test_millimetres_become_metres() -> None:
    frame = Feeder(unit="mm").play(range(5), 1, at=(500.0, 1000.0, -250.0))[-1]
    np.testing.assert_allclose(frame.body_positions[0], [0.5, 1.0, -0.25])


@pytest.mark.parametrize(
    "pose",
    [
        {"at": (9_999_999.0, 9_999_999.0, 9_999_999.0)},
        {"at": (float("nan"), 0.0, 0.0)},
        {"q": (0.0, 0.0, 0.0, 0.0)},
        {"q": (0.0, 0.0, 0.6, 0.9)},
    ],
)
def test_implausible_poses_are_absent_and_counted(pose: dict[str, Any]) -> None:
    feeder = Feeder()
    feeder.play(range(5), 1)
    count = feeder.decoder.suspicious
    frame = feeder.play(range(5, 6), 1, **pose)[-1]
    assert np.isnan(frame.body_positions).all()
    assert np.isnan(frame.body_orientations).all()
    assert feeder.decoder.suspicious == count + 1


@pytest.mark.parametrize("step_us", [-3_600_000_000, -250_000, 150_000, 60_000_000])
def test_a_step_of_the_servers_clock_restarts_the_clock(step_us: int) -> None:
    feeder = Feeder()
    feeder.play(range(100), 1)
    for n in range(100, 110):
        t_us = T0_US + n * PERIOD_US
        feeder(report(1, t_us + step_us), t_us=t_us)
    (restart,) = feeder.events("restart")
    assert f"{step_us / 1e6:+.3f} s" in restart.text
    assert len(feeder.frames) == 110


def test_messages_delayed_by_the_network_are_no_step() -> None:
    feeder = Feeder()
    feeder.play(range(100), 1)
    late_us = T0_US + 130 * PERIOD_US
    for n in range(100, 130):
        feeder(report(1, T0_US + n * PERIOD_US), t_us=late_us)
    feeder.play(range(130, 150), 1)
    assert not feeder.events("restart")


def test_repeated_and_reordered_datagrams_are_dropped_and_counted() -> None:
    feeder = Feeder()
    for n in (0, 1, 2, 2, 4, 3, 5):
        feeder(report(1, T0_US + n * PERIOD_US), t_us=T0_US + n * PERIOD_US)
    assert [frame.ticks for frame in feeder.frames] == [
        T0_US + n * PERIOD_US for n in (0, 1, 2, 4, 5)
    ]
    assert (feeder.decoder.repeated_reports, feeder.decoder.late_reports) == (1, 1)


def test_another_major_version_and_lost_synchronization_are_reported() -> None:
    feeder = Feeder()
    out = feeder(encode(vrpn.Cookie(8, 0)), b"\xff" * 5000)
    assert feeder.events("error")[0].data == {"vrpn": "08.00"}
    assert any(isinstance(item, Corrupt) for item in out)


def test_unix_time_is_declared_in_the_configuration() -> None:
    assert Feeder().decoder.tick_clock.scale == "own"
    assert Feeder(time="utc").decoder.tick_clock.scale == "unix"
