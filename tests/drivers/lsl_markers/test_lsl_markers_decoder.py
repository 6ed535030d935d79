"""The decoder of LSL streams: channels, units, axes, occlusion, time and changed streams."""

from __future__ import annotations

from math import nan
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from jointfit_daemon.model import Chunk, ClockEcho, Decoded, DeviceEvent, MocapFrame
from jointfit_drivers.lsl_markers import LslMarkersDecoder, LslMarkersSettings
from jointfit_protocols.lsl import (
    RoundTrip,
    encode_description,
    encode_round_trip,
    encode_samples,
)

NS = 1_000_000_000
T0_NS = 500 * NS
STAMP_S = 7000.0


def channel(**fields: str) -> str:
    inside = "".join(f"<{name}>{text}</{name}>" for name, text in fields.items())
    return f"<channel>{inside}</channel>"


def marker(name: str, unit: str = "meters", **more: str) -> list[str]:
    return [
        channel(label=f"{name}_{axis}", marker=name, type=f"Position{axis}", unit=unit, **more)
        for axis in "XYZ"
    ]


def body(name: str, turns: str = "ABCD") -> list[str]:
    places = [channel(label=f"{name}_{a}", object=name, type=f"Position{a}") for a in "XYZ"]
    return places + [channel(label=name, object=name, type=f"Orientation{a}") for a in turns]


def labels(*names: str) -> list[str]:
    return [channel(label=name) for name in names]


class Feeder:
    """A decoder of one stream, and everything that it returned."""

    def __init__(
        self,
        channels: list[str],
        count: int | None = None,
        manufacturer: str = "",
        **settings: Any,
    ) -> None:
        table = {"driver": "lsl-markers", "up_axis": "z", **settings}
        self.acquisition = f"<acquisition><manufacturer>{manufacturer}</manufacturer></acquisition>"
        self.decoder = LslMarkersDecoder(LslMarkersSettings.model_validate(table))
        self.items: list[Decoded] = []
        self.connect(channels, count)

    def connect(self, channels: list[str], count: int | None = None) -> None:
        self.rate = 100
        described = f"<channels>{''.join(channels)}</channels>" if channels else ""
        self._feed(
            encode_description(
                f"<info><name>Lab</name><type>MoCap</type><hostname>pc</hostname>"
                f"<channel_count>{count or len(channels)}</channel_count>"
                f"<nominal_srate>{self.rate}</nominal_srate>"
                f"<channel_format>double64</channel_format><desc>{described}"
                f"{self.acquisition}</desc></info>"
            ),
            T0_NS,
        )

    def _feed(self, data: bytes, t_ns: int) -> list[Decoded]:
        out = self.decoder.feed(Chunk(t_ns, data))
        self.items += out
        return out

    def __call__(self, *values: float, at_s: float = 0.0, late_ns: int = 0) -> MocapFrame:
        data = encode_samples("double64", [STAMP_S + at_s], [values])
        out = self._feed(data, T0_NS + round(at_s * NS) + late_ns)
        (frame,) = (item for item in out if isinstance(item, MocapFrame))
        return frame

    def trip(self, at_s: float = 0.0, difference_s: float = 0.0) -> list[Decoded]:
        middle_ns = T0_NS + round(at_s * NS)
        trip = RoundTrip(middle_ns - 50_000, middle_ns + 50_000, STAMP_S + at_s + difference_s)
        return self._feed(encode_round_trip(trip), middle_ns)

    def texts(self, *kinds: str) -> str:
        return " | ".join(
            item.text
            for item in self.items
            if isinstance(item, DeviceEvent) and (not kinds or item.kind in kinds)
        )


def test_markers_and_bodies_have_their_names_and_si_units() -> None:
    feed = Feeder(
        [*marker("T1", "millimeters"), *body("Thigh")],
        unit="mm",
        markers={"thigh": ["T1"]},
        rigid_body={"shank": "Thigh"},
    )
    frame = feed(1.0, 2.0, 3.0, 1000.0, 0.0, -500.0, 0.5, -0.5, 0.5, 0.5)
    assert frame.layout.markers == ("T1",)
    assert frame.layout.bodies == ("Thigh",)
    np.testing.assert_allclose(frame.markers, [[0.001, 0.002, 0.003]])
    np.testing.assert_allclose(frame.body_positions, [[1.0, 0.0, -0.5]])
    np.testing.assert_allclose(frame.body_orientations, [[0.5, -0.5, 0.5, 0.5]])
    assert frame.ticks == round(STAMP_S * NS)
    assert feed.texts("warning", "error") == ""


def test_frames_of_a_stream_without_numbers_are_not_compared_with_a_counter() -> None:
    feed = Feeder(marker("T1"), markers={"thigh": ["T1"]})
    assert [feed(1.0, 2.0, 3.0, at_s=at_s).counted for at_s in (0.0, 0.01)] == [False, False]


def test_the_unit_of_the_channels_is_used() -> None:
    for unit, length_m in (("meters", 1.0), ("mm", 0.001), ("Centimeters", 0.01), ("", 1.0)):
        assert Feeder(marker("T1", unit))(1.0, 0.0, 0.0).markers[0, 0] == pytest.approx(length_m)


def test_an_unknown_unit_and_a_wrong_one_are_reported() -> None:
    assert "set unit in [mocap]" in Feeder(marker("T1", "feet")).texts("warning")
    wrong = Feeder(marker("T1", "meters"))
    wrong(800.0, 100.0, 900.0)
    assert 'set unit = "mm"' in wrong.texts("warning")


def test_the_vertical_axis_is_turned_up() -> None:
    frame = Feeder(marker("T1"), up_axis="y")(1.0, 2.0, 3.0)
    np.testing.assert_allclose(frame.markers, [[1.0, -3.0, 2.0]])


@pytest.mark.parametrize("absent", [nan, float("inf"), 0.0, 1e9])
def test_what_is_not_seen_is_missing_and_never_zero(absent: float) -> None:
    feed = Feeder([*marker("T1"), *marker("T2"), *body("Thigh")], rigid_body={"thigh": "Thigh"})
    frame = feed(*(absent,) * 3, 1.0, 2.0, 3.0, *(absent,) * 7)
    assert np.isnan(frame.markers[0]).all()
    assert np.isfinite(frame.markers[1]).all()
    assert np.isnan(frame.body_positions).all()
    assert np.isnan(frame.body_orientations).all()


def test_a_marker_without_confidence_is_missing() -> None:
    feed = Feeder([*marker("T1"), channel(label="T1_c", marker="T1", type="Confidence")])
    assert np.isfinite(feed(1.0, 2.0, 3.0, 0.7).markers).all()
    assert np.isnan(feed(1.0, 2.0, 3.0, 0.0, at_s=0.01).markers).all()


def test_labels_replace_missing_types() -> None:
    feed = Feeder(labels("T1_X", "T1_Y", "T1_Z", "A x", "A y", "A z", "A.qw", "A.qx", "A.qy",
                         "A.qz", "frame"))  # fmt: skip
    frame = feed(1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1.0, 0.0, 0.0, 0.0, 77.0)
    assert (frame.layout.markers, frame.layout.bodies) == (("T1",), ("A",))
    np.testing.assert_allclose(frame.body_positions, [[4.0, 5.0, 6.0]])


def test_names_of_the_configuration_replace_a_missing_description() -> None:
    frame = Feeder([], 6, names=["T1", "T2"])(1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    assert frame.layout.markers == ("T1", "T2")
    np.testing.assert_allclose(frame.markers[1], [4.0, 5.0, 6.0])

    assert "set names in [mocap]" in Feeder([], 6).texts("warning")
    assert "9 channels; the stream has 6" in Feeder([], 6, names=["a", "b", "c"]).texts("warning")


def test_streams_of_other_content_are_named() -> None:
    feed = Feeder(labels("Fp1", "Fp2", "Cz"))
    assert "found Fp1, Fp2, Cz" in feed.texts("warning")


def test_euler_angles_and_incomplete_markers_are_reported() -> None:
    feed = Feeder([*body("Thigh", "PHR"), *marker("T1")[:2]])
    assert "Thigh have Euler angles" in feed.texts("warning")
    assert "T1 without all three coordinates" in feed.texts("warning")
    assert feed(*(1.0,) * 8).layout.bodies == ()


@pytest.mark.parametrize(
    ("manufacturer", "order", "expected"),
    [
        ("PhaseSpace", "auto", [0.1, 0.5, 0.5, 0.7]),
        ("NaturalPoint", "auto", [0.7, 0.1, 0.5, 0.5]),
        ("NaturalPoint", "wxyz", [0.1, 0.5, 0.5, 0.7]),
        ("", "xyzw", [0.7, 0.1, 0.5, 0.5]),
    ],
)
def test_the_program_or_the_setting_decides_where_the_scalar_of_a_quaternion_is(
    manufacturer: str, order: str, expected: list[float]
) -> None:
    feed = Feeder(body("Thigh"), manufacturer=manufacturer, quaternion_order=order)
    frame = feed(1.0, 2.0, 3.0, 0.1, 0.5, 0.5, 0.7)
    np.testing.assert_allclose(frame.body_orientations, [expected])


@pytest.mark.parametrize("word", ["Quaternion", "Rotation", "Orientation"])
def test_types_that_name_the_component_of_a_quaternion_are_read(word: str) -> None:
    places = [channel(label="", object="Thigh", type=f"Position{axis}") for axis in "XYZ"]
    turns = [channel(label="", object="Thigh", type=f"{word}{axis}") for axis in "XYZW"]
    frame = Feeder([*places, *turns])(1.0, 2.0, 3.0, 0.5, -0.5, 0.5, 0.5)
    np.testing.assert_allclose(frame.body_orientations, [[0.5, 0.5, -0.5, 0.5]])

    feed = Feeder([*places, *turns[:3]])
    assert "Thigh have Euler angles" in feed.texts("warning")


def test_labels_of_another_quantity_are_no_positions() -> None:
    turned = labels("A_quat_x", "A_quat_y", "A_quat_z", "A_quat_w", "A_pos_x", "A_pos_y", "A_pos_z")
    frame = Feeder(turned)(0.5, -0.5, 0.5, 0.5, 1.0, 2.0, 3.0)
    assert (frame.layout.markers, frame.layout.bodies) == ((), ("A",))
    np.testing.assert_allclose(frame.body_positions, [[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(frame.body_orientations, [[0.5, 0.5, -0.5, 0.5]])

    fast = labels("A_vel_x", "A_vel_y", "A_vel_z", "A_x", "A_y", "A_z")
    frame = Feeder(fast)(9.0, 9.0, 9.0, 1.0, 2.0, 3.0)
    np.testing.assert_allclose(frame.markers, [[1.0, 2.0, 3.0]])
    typed = [channel(label=f"A_{axis}", marker="A", type=f"Velocity{axis}") for axis in "XYZ"]
    frame = Feeder([*typed, *marker("A")])(9.0, 9.0, 9.0, 1.0, 2.0, 3.0)
    np.testing.assert_allclose(frame.markers, [[1.0, 2.0, 3.0]])


def test_labels_of_the_configuration_describe_bodies_and_other_channels() -> None:
    named = ["frame", "A_x", "A_y", "A_z", "A_qx", "A_qy", "A_qz", "A_qw"]
    frame = Feeder([], 8, labels=named)(77.0, 1.0, 2.0, 3.0, 0.5, -0.5, 0.5, 0.5)
    np.testing.assert_allclose(frame.body_positions, [[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(frame.body_orientations, [[0.5, 0.5, -0.5, 0.5]])

    wrong = Feeder([], 8, labels=named[:7])
    assert "labels lists 7 channels; the stream has 8" in wrong.texts("warning")
    assert "labels to the label of every channel" in Feeder([], 8).texts("warning")


def test_samples_that_share_one_time_stamp_are_reported_once() -> None:
    feed = Feeder(marker("T1"))
    for chunk in range(10):
        for _ in range(16):
            feed(1.0, 2.0, 3.0, at_s=0.16 * chunk)
    texts = feed.texts("warning")
    assert texts.count("have the time stamp of the previous sample") == 1
    assert "set the nominal rate" in texts

    rare = Feeder(marker("T1"))
    for number in range(200):
        rare(1.0, 2.0, 3.0, at_s=0.01 * (number - number % 3 // 2))
    assert "time stamp of the previous sample" not in rare.texts("warning")


def test_markers_of_the_same_name_are_told_apart_by_their_object() -> None:
    one = [*marker("T1", object="Left"), *marker("T1", object="Right")]
    assert Feeder(one)(*range(1, 7)).layout.markers == ("Left/T1", "Right/T1")
    assert "is ambiguous" in Feeder(one, markers={"thigh": ["T1"]}).texts("warning")


def test_a_changed_number_of_channels_is_named_after_reconnection() -> None:
    feed = Feeder([*marker("T1"), *marker("T2")], markers={"thigh": ["T1", "T2"]})
    feed.connect(marker("T1"))
    assert "had 6 channels and has 3 since the new connection" in feed.texts("warning")
    assert "marker 'T2' (mocap.markers.thigh) is not in the stream" in feed.texts("warning")
    assert feed(1.0, 2.0, 3.0).layout.markers == ("T1",)


def test_comparisons_of_the_clocks_are_echoes() -> None:
    """A comparison of the clocks of host and sender is decoded as a `ClockEcho`."""
    feed = Feeder(marker("T1"))
    assert feed.trip() == []  # the clock of the stamps is not known before the first sample
    feed(1.0, 2.0, 3.0, at_s=0.1, late_ns=2_000_000)
    (echo,) = feed.trip(at_s=0.2)
    assert isinstance(echo, ClockEcho)
    assert echo.received_ns - echo.sent_ns == 100_000
    assert echo.ticks == round((STAMP_S + 0.2) * NS)
    assert sum(isinstance(item, ClockEcho) for item in feed.items) == 2


def test_stamps_of_another_clock_are_reported_and_give_no_echo() -> None:
    """The stamps come from another clock than the sender's, which LSL compares with the host's."""
    feed = Feeder(marker("T1"))
    feed(1.0, 2.0, 3.0)
    feed.trip(difference_s=-900.0)
    feed.trip(at_s=5.0, difference_s=-900.0)
    assert 'set time = "sender"' in feed.texts("warning")
    assert not any(isinstance(item, ClockEcho) for item in feed.items)

    quiet = Feeder(marker("T1"), time="sender")
    quiet(1.0, 2.0, 3.0)
    quiet.trip()
    assert quiet.texts("warning") == ""
    assert not any(isinstance(item, ClockEcho) for item in quiet.items)


def test_lost_samples_and_a_restarted_sender_are_events() -> None:
    feed = Feeder(marker("T1"))
    for n in range(3):
        feed(1.0, 2.0, 3.0, at_s=0.01 * n)
    feed(1.0, 2.0, 3.0, at_s=0.52)
    assert feed.texts("gap") == "49 samples lost"
    feed(1.0, 2.0, 3.0, at_s=-100.0)
    assert "stepped by -100.520 s" in feed.texts("restart")


def test_a_stamp_that_is_no_time_drops_its_sample() -> None:
    feed = Feeder(marker("T1"))
    data = encode_samples("double64", [nan, 1e300, STAMP_S], [[1.0, 2.0, 3.0]] * 3)
    assert len(feed.decoder.feed(Chunk(T0_NS, data))) == 1
    assert feed.decoder.suspicious == 2


@given(st.lists(st.floats(), min_size=10, max_size=10))
def test_any_numbers_give_finite_poses_or_none(values: list[float]) -> None:
    frame = Feeder([*marker("T1"), *body("Thigh")])(*values)
    for rows in (frame.markers, frame.body_positions, frame.body_orientations):
        assert np.isfinite(rows).all() or np.isnan(rows).all()


def test_settings_that_contradict_each_other_are_refused() -> None:
    def fault(**keys: Any) -> str:
        with pytest.raises(ValidationError) as error:
            LslMarkersSettings.model_validate({"driver": "lsl-markers", **keys})
        return str(error.value)

    assert "predicate replaces this key" in fault(stream="a", predicate="name='a'")
    assert "'a' occurs twice" in fault(names=["a", "a"])
    assert "labels replaces this key" in fault(names=["a"], labels=["a_x"])
    assert "both kinds of quotation marks" in fault(stream="a'\"")
    assert "expected one address or name" in fault(server="a b")
