"""Raw readings of an Xbus device yield the orientation that the package `vqf` computes."""

from __future__ import annotations

import importlib
from itertools import pairwise
from math import cos, radians, sin
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.model import Chunk, Corrupt, DeviceEvent, ImuSample
from jointfit_drivers.gateway_orientation import GatewayOrientation, RawReading, _filter
from jointfit_drivers.xbus import XbusImu, XbusSettings
from jointfit_protocols import xbus
from jointfit_protocols.xbus import mtdata2
from jointfit_protocols.xbus.mtdata2 import Item, Precision, real_id
from jointfit_simulators.devices._inertial_signals import InertialSignals

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Decoded

vqf = pytest.importorskip("vqf")
STILL = (0.0, 0.0, 0.0)
UP = (0.0, 0.0, 9.81)
TICKS = 100  # ticks of the device clock per sample at 100 Hz


def setup(rate_hz: int = 100, **more: Any) -> XbusSettings:
    table: dict[str, Any] = {"orientation": "gateway", "settle_s": 0.0} | more
    return XbusSettings(
        id="S1", segment="thigh", driver="xbus", port="p", baud=921_600, rate_hz=rate_hz, **table
    )


def message(counter: int, ticks: int, *items: tuple[int, Any]) -> bytes:
    head = [(Item.PACKET_COUNTER, counter & 0xFFFF), (Item.SAMPLE_TIME_FINE, ticks % 2**32)]
    return xbus.encode(xbus.XbusMessageId.MT_DATA2, mtdata2.encode_items([*head, *items]))


def decoded(messages: list[bytes], **more: Any) -> list[Decoded]:
    decoder = XbusImu(setup(**more)).decoder()
    return [
        event for k, data in enumerate(messages) for event in decoder.feed(Chunk(k * 10_000, data))
    ]


def samples(events: list[Decoded]) -> list[ImuSample]:
    return [event for event in events if isinstance(event, ImuSample)]


def orientations(events: list[Decoded]) -> Array:
    return np.array([sample.q_world_sensor for sample in samples(events)])


def turning(n: int, rate: float = 1.0) -> list[tuple[tuple[int, Any], ...]]:
    """Return the raw items of a sensor that turns about the vertical at `rate`, rad/s."""
    return [((Item.RATE_OF_TURN, (0.0, 0.0, rate)), (Item.ACCELERATION, UP))] * n


def angle(a: Any, b: Any) -> float:
    return float(rotation.angle_between(np.asarray(a), np.asarray(b)))


@pytest.mark.parametrize(
    ("name", "goal_deg"),
    [("02_undisturbed_slow_rotation_B", 1.5), ("07_undisturbed_fast_rotation_B", 1.9)],
)
def test_a_real_trial_through_the_driver_equals_the_package_run_directly(
    shared_data: Path, name: str, goal_deg: float
) -> None:
    with np.load(shared_data / "broad_excerpts" / f"{name}_60s.npz", allow_pickle=False) as trial:
        felt = [np.ascontiguousarray(trial[f"imu_{k}"], np.float64) for k in ("gyr", "acc", "mag")]
        optical = np.asarray(trial["opt_quat"], dtype=np.float64)
    kinds = (Item.RATE_OF_TURN, Item.ACCELERATION, Item.MAGNETIC_FIELD)
    wires = [
        message(k, 35 * k, *zip(kinds, (tuple(row.tolist()) for row in rows), strict=True))
        for k, rows in enumerate(zip(*felt, strict=True))
    ]
    said = orientations(decoded(wires, rate_hz=286, magnetometer=True))
    direct = vqf.VQF(0.0035).updateBatch(*felt)["quat9D"]
    assert len(said) == len(direct)
    assert rotation.angle_between(said, direct).max() < 1e-12
    seen = np.isfinite(optical[:, 0]) & (np.arange(len(optical)) > 9 * 286)
    error = rotation.angle_between(said[seen], optical[seen])
    assert np.rad2deg(np.sqrt(np.mean(error**2))) < goal_deg + 0.6  # the trial lasts a minute


def test_the_interval_is_that_of_the_device_clock_and_not_the_nominal_one() -> None:
    wires = [message(k, 101 * k, *items) for k, items in enumerate(turning(1000))]
    said = orientations(decoded(wires))
    turned = np.unwrap(2 * np.arctan2(said[:, 3], said[:, 0]))[-1]
    felt = np.tile((0.0, 0.0, 1.0), (1000, 1)), np.tile(UP, (1000, 1))
    direct = vqf.VQF(0.0101).updateBatch(*felt)
    w, _, _, z = direct["quat6D"].T
    assert turned == pytest.approx(np.unwrap(2 * np.arctan2(z, w))[-1], abs=1e-9)
    assert turned > 1.005 * 10.0


def test_ticks_too_coarse_for_one_interval_do_not_change_the_rotation() -> None:
    """At 60 Hz, an interval is 166.67 ticks. Rounding a single interval gives an error of 0.4 %."""
    orientation = GatewayOrientation(60.0, magnetometer=False, settle_s=0.0)
    turned, before = 0.0, None
    for k in range(1201):
        t_ns = k * 500 // 3 * 100_000
        for found in orientation.take(RawReading(t_ns, (0.0, 0.0, 1.0), UP)).oriented:
            q = found.q_world_sensor
            if before is not None:
                turned += angle(before, q)
            before = q
    assert turned == pytest.approx(1200 / 60, rel=2e-5)


def test_the_first_sample_waits_for_the_second_and_none_is_lost() -> None:
    wires = [message(k, 100 * k, *items) for k, items in enumerate(turning(10))]
    decoder = XbusImu(setup()).decoder()
    counts = [len(samples(decoder.feed(Chunk(k, data)))) for k, data in enumerate(wires)]
    assert counts == [0, 2, *[1] * 8]


@pytest.mark.parametrize("lost", [1, 2, 3])
def test_a_short_gap_is_interpolated(lost: int) -> None:
    wires = [message(k, 100 * k, *items) for k, items in enumerate(turning(300))]
    whole, gapped = decoded(wires), decoded(wires[:150] + wires[150 + lost :])
    assert angle(samples(whole)[-1].q_world_sensor, samples(gapped)[-1].q_world_sensor) < 1e-6
    assert not [e for e in gapped if isinstance(e, DeviceEvent) and "restarted" in e.text]


def test_filter_restarts_with_the_same_heading_after_a_long_gap() -> None:
    wires = [message(k, 100 * k, *items) for k, items in enumerate(turning(300))]
    events = decoded(wires[:150] + wires[160:])
    told = [e for e in events if isinstance(e, DeviceEvent) and "filter restarted" in e.text]
    assert [(e.kind, e.data) for e in told] == [("warning", {"missing": 10})]
    found = samples(events)
    before, after = found[149].q_world_sensor, found[150].q_world_sensor
    assert angle(before, after) < 0.02  # the rotation during the gap is unknown and not estimated


def test_a_tilt_after_a_long_gap_comes_from_the_accelerometer() -> None:
    tilted = (0.0, 9.81 * sin(0.5), 9.81 * cos(0.5))
    felt = [UP] * 200 + [tilted] * 200
    wires = [
        message(k, 100 * (k + 20 * (k >= 200)), (Item.RATE_OF_TURN, STILL), (Item.ACCELERATION, f))
        for k, f in enumerate(felt)
    ]
    last = samples(decoded(wires))[200].q_world_sensor
    assert angle(last, (cos(0.25), sin(0.25), 0.0, 0.0)) < 1e-3


def test_increments_yield_the_same_orientation_as_rates() -> None:
    half = 0.5 * 1.0 * 0.01
    items = (
        (Item.DELTA_Q, (cos(half), 0.0, 0.0, sin(half))),
        (Item.DELTA_V, (0.0, 0.0, 0.0981)),
    )
    by_increments = decoded([message(k, 100 * k, *items) for k in range(500)])
    by_rates = decoded([message(k, 100 * k, *rates) for k, rates in enumerate(turning(500))])
    assert rotation.angle_between(orientations(by_increments), orientations(by_rates)).max() < 1e-4


def tumbling(n: int) -> list[tuple[tuple[int, Any], ...]]:
    """Return raw items of a sensor that never rests."""
    return [
        (
            (Item.RATE_OF_TURN, (sin(0.1 * k), cos(0.07 * k), 0.5)),
            (Item.ACCELERATION, (2.0 * sin(0.2 * k), 1.0, 9.0)),
        )
        for k in range(n)
    ]


@pytest.mark.parametrize(("contents", "first_s"), [(tumbling(600), 3.0), (turning(600, 0.1), 3.0)])
def test_no_sample_is_emitted_before_the_filter_has_settled(
    contents: list[tuple[tuple[int, Any], ...]], first_s: float
) -> None:
    wires = [message(k, 100 * k, *items) for k, items in enumerate(contents)]
    settled, at_once = samples(decoded(wires, settle_s=3.0)), samples(decoded(wires))
    assert settled[0].ticks == round(first_s * 100) * TICKS
    assert settled == at_once[-len(settled) :]  # the output equals the output without settling


def test_a_filter_at_rest_settles_sooner() -> None:
    wires = [
        message(k, 100 * k, (Item.RATE_OF_TURN, STILL), (Item.ACCELERATION, UP)) for k in range(400)
    ]
    first = samples(decoded(wires, settle_s=3.0))[0]
    assert first.ticks is not None
    assert 1.4 < first.ticks * 1e-4 < 1.6


def test_heading_after_a_start_in_fast_motion_is_settled_with_the_inclination(
    shared_data: Path,
) -> None:
    """After each of 24 starts in rotation at 579 °/s RMS, the RMS error is below 6°."""
    with np.load(shared_data / "broad_excerpts" / "07_undisturbed_fast_rotation_B_60s.npz") as file:
        felt = [file[f"imu_{kind}"].astype(float).tolist() for kind in ("gyr", "acc", "mag")]
        optical = file["opt_quat"].astype(float)
    errors = []
    for start in range(571, 571 + 24 * 572, 572):
        filter_ = GatewayOrientation(2000 / 7, magnetometer=True)
        found = {
            k: step.oriented[-1].q_world_sensor
            for k in range(start, start + 1144)
            if (
                step := filter_.take(RawReading(k * 3_500_000, *(part[k] for part in felt)))
            ).oriented
        }
        off = rotation.angle_between(np.array([*found.values()]), optical[list(found)])
        errors.append(np.degrees(np.sqrt(np.mean(off**2))))
    assert max(errors) < 6.0  # with a filter that uses the field from its start on, 7.1°


def delayed_fields(delay_s: float, amplitude: float) -> tuple[np.ndarray, ...]:
    """Return orientations, angular rates and fields of a sensor that oscillates about x and y."""
    t_s = np.arange(0.0, 3.0, 0.0025)

    def pose(at_s: np.ndarray) -> np.ndarray:
        about_x, about_y = np.zeros((2, len(at_s), 3))
        about_x[:, 0] = amplitude * np.sin(2.0 * np.pi * at_s)
        about_y[:, 1] = amplitude * np.sin(3.0 * np.pi * at_s)
        return rotation.multiply(rotation.exp(about_x), rotation.exp(about_y))

    q, step_s = pose(t_s), 1e-5
    turned = rotation.multiply(rotation.conjugate(q), pose(t_s + step_s))
    world = np.tile([0.0, 20.0, -44.0], (len(t_s), 1))
    fields = rotation.rotate(rotation.conjugate(pose(t_s - delay_s)), world)
    return q, rotation.log(turned) / step_s, fields


def test_delay_of_the_magnetometer_is_estimated_in_spite_of_an_absurd_field() -> None:
    q, rates, fields = delayed_fields(0.013, 1.5)
    clean = _filter._field_delay(q, rates, fields)
    assert clean == pytest.approx(0.013, rel=0.15)
    fields[500] = (1e5, -1e5, 1e5)
    found = _filter._field_delay(q, rates, fields)
    assert found == pytest.approx(clean, rel=0.01)


def test_delay_of_the_magnetometer_is_unknown_at_rest() -> None:
    assert _filter._field_delay(*delayed_fields(0.013, 0.0)) is None


def test_field_beyond_all_sensors_is_refused() -> None:
    reading = RawReading(0, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81), (1e200, 0.0, 0.0))
    assert not _filter.is_plausible(reading)


def test_after_a_long_gap_in_fast_motion_the_sensor_is_silent_till_it_has_settled() -> None:
    contents = tumbling(1200)
    wires = [message(k, 100 * k, *items) for k, items in enumerate(contents)]
    events = decoded(wires[:600] + wires[620:], settle_s=3.0)
    ticks = [sample.ticks for sample in samples(events)]
    assert ticks[-1] == 1199 * TICKS
    gap = [(a, b) for a, b in pairwise(ticks) if a is not None and b is not None and b - a > TICKS]
    assert gap == [(599 * TICKS, 920 * TICKS)]
    assert sum(isinstance(e, DeviceEvent) and "filter restarted" in e.text for e in events) == 1


def test_a_fast_rate_that_repeats_itself_is_at_the_end_of_its_range() -> None:
    """A fast rate that repeats is saturated, even without a status word. Slow rates may repeat."""
    fast = [(7.85398, 0.0, 0.0)] * 3 + [(7.0 + 0.01 * k, 0.1, 0.2) for k in range(30)]
    slow = [(1.0, 0.0, 0.0)] * 30
    for rates, expected in ((fast, 1), (slow, 0), (fast[3:], 0)):
        wires = [
            message(k, 100 * k, (Item.RATE_OF_TURN, rate), (Item.ACCELERATION, UP))
            for k, rate in enumerate(rates)
        ]
        told = [
            e for e in decoded(wires) if isinstance(e, DeviceEvent) and "out of range" in e.text
        ]
        assert len(told) == expected


@pytest.mark.parametrize("precision", list(Precision))
def test_every_precision_of_raw_items_is_understood(precision: Precision) -> None:
    kinds = (real_id(Item.RATE_OF_TURN, precision), real_id(Item.ACCELERATION, precision))
    wires = [message(k, 100 * k, *zip(kinds, (STILL, UP), strict=True)) for k in range(5)]
    found = samples(decoded(wires))
    assert len(found) == 5
    assert found[-1].acceleration == pytest.approx(UP, abs=1e-6)


def test_sample_of_the_raw_filter_has_acceleration_and_field_but_no_mean_rate() -> None:
    """The mean rate is half a period old. Its use multiplies the error of fast motion by four."""
    bias = (0.01, -0.02, 0.005)
    items = ((Item.RATE_OF_TURN, bias), (Item.ACCELERATION, UP), (Item.MAGNETIC_FIELD, (1.0, 0, 0)))
    found = samples(decoded([message(k, 100 * k, *items) for k in range(1500)], magnetometer=True))
    assert found[-1].rate is None
    assert found[-1].magnetic == (1.0, 0.0, 0.0)
    assert found[-1].acceleration == pytest.approx(UP, abs=1e-6)


def test_rest_and_bias_are_reported_every_ten_seconds() -> None:
    items = ((Item.RATE_OF_TURN, (0.01, 0.0, 0.0)), (Item.ACCELERATION, UP))
    events = decoded([message(k, 100 * k, *items) for k in range(3000)])
    states: list[Any] = [
        e.data["orientation_filter"]
        for e in events
        if isinstance(e, DeviceEvent) and "orientation_filter" in e.data
    ]
    assert 3 <= len(states) <= 5
    assert states[-1]["rest"] is True
    assert states[-1]["bias_rad_s"] == pytest.approx([0.01, 0.0, 0.0], abs=2e-4)
    assert states[-1]["period_ms"] == 10.0


def test_heading_without_magnetometer_is_reported_at_the_start() -> None:
    field = (Item.MAGNETIC_FIELD, (0.0, 0.4, -0.9))
    free = decoded([message(k, 100 * k, *items) for k, items in enumerate(turning(20))])
    north = decoded(
        [message(k, 100 * k, *items, field) for k, items in enumerate(turning(20))],
        magnetometer=True,
    )
    warned = [
        [e.text for e in run if isinstance(e, DeviceEvent) and e.kind == "warning"]
        for run in (free, north)
    ]
    assert len(warned[0]) == 1
    assert "repeat the static pose" in warned[0][0]
    assert warned[1] == []


@given(st.lists(st.floats(width=32), min_size=6, max_size=6))
@settings(max_examples=60, deadline=None)
def test_after_any_readings_the_orientations_remain_finite(values: list[float]) -> None:
    bad = ((Item.RATE_OF_TURN, tuple(values[:3])), (Item.ACCELERATION, tuple(values[3:])))
    sound = turning(6)
    contents = [*sound[:3], bad, *sound[3:]]
    events = decoded([message(k, 100 * k, *items) for k, items in enumerate(contents)])
    refused = sum(isinstance(event, Corrupt) for event in events)
    assert len(samples(events)) + refused == len(contents)
    assert np.isfinite(orientations(events)).all()


def test_the_same_chunks_give_the_same_orientations_bit_by_bit() -> None:
    wires = [message(k, 100 * k, *items) for k, items in enumerate(turning(100))]
    assert decoded(wires) == decoded(wires)


def test_the_device_clock_may_wrap() -> None:
    start = 2**32 - 150 * TICKS
    wires = [message(k, start + 100 * k, *items) for k, items in enumerate(turning(300))]
    plain = [message(k, 100 * k, *items) for k, items in enumerate(turning(300))]
    assert np.array_equal(orientations(decoded(wires)), orientations(decoded(plain)))


def test_a_device_that_restarts_begins_a_new_filter() -> None:
    first = [message(k, 10_000_000 + 100 * k, *items) for k, items in enumerate(turning(50))]
    again = [message(k, 100 * k, *items) for k, items in enumerate(turning(50))]
    events = decoded(first + again)
    kinds = [e.kind for e in events if isinstance(e, DeviceEvent) and e.kind == "restart"]
    assert kinds == ["restart"]
    assert samples(events)[-1].q_world_sensor == samples(decoded(again))[-1].q_world_sensor


def test_clipped_reading_is_reported_once() -> None:
    wires = [
        message(k, 100 * k, *items, (Item.STATUS_WORD, mtdata2.CLIPPING))
        for k, items in enumerate(turning(50))
    ]
    events = decoded(wires)
    told = [e for e in events if isinstance(e, DeviceEvent) and "out of range" in e.text]
    assert len(told) == 1
    assert samples(events)[0].status == mtdata2.CLIPPING


def test_without_the_package_the_rig_is_refused_with_the_remedy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(_filter, "find_spec", lambda _: None)
    with pytest.raises(ValidationError, match=r"pip install 'jointfitd\[vqf\]'"):
        setup()
    assert setup(orientation="device").orientation == "device"


def test_a_magnetometer_without_a_filter_is_refused() -> None:
    with pytest.raises(ValidationError, match="needs orientation"):
        setup(orientation="device", magnetometer=True)


def test_the_driver_does_not_import_the_optional_package_of_the_filter() -> None:
    module = importlib.import_module("jointfit_drivers.xbus._driver")
    assert "vqf" not in vars(module)


@given(
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(c * c for c in q) > 0.1),
    st.tuples(*[st.floats(-0.5, 0.5)] * 3),
)
def test_a_simulated_sensor_measures_its_rotation(
    start: tuple[float, float, float, float], turn: tuple[float, float, float]
) -> None:
    before = rotation.normalize(np.array(start))
    after = rotation.multiply(before, rotation.exp(np.array(turn)))
    felt = InertialSignals()
    felt.update(0, tuple(before.tolist()))
    felt.update(10_000_000, tuple(after.tolist()))
    rate, force = felt.value(Item.RATE_OF_TURN), felt.value(Item.ACCELERATION)
    assert rate is not None
    assert force is not None
    assert np.array(rate) * 0.01 == pytest.approx(np.array(turn), abs=1e-9)
    assert rotation.rotate(after, np.array(force)) == pytest.approx(np.array(UP), abs=1e-9)


def test_filtered_simulated_readings_reproduce_the_movement() -> None:
    felt, wires, truth = InertialSignals(), [], []
    for k in range(1500):
        q = rotation.exp(np.array([0.6 * sin(0.02 * k), 0.3 * sin(0.013 * k), 0.4 * sin(0.01 * k)]))
        truth.append(q)
        felt.update(k * 10_000_000, tuple(q.tolist()))
        kinds = (Item.RATE_OF_TURN, Item.ACCELERATION, Item.MAGNETIC_FIELD)
        wires.append(message(k, 100 * k, *((kind, felt.value(kind)) for kind in kinds)))
    said = orientations(decoded(wires, magnetometer=True))
    error = rotation.angle_between(said[500:], np.array(truth)[500:])
    assert error.max() < radians(2.0)
    steps = [angle(a, b) for a, b in pairwise(said[500:])]
    assert max(steps) < 0.02
