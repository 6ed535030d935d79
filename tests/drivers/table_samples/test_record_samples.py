"""Samples from records: canonical orientations, losses, restarts, corrupt and invalid values."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.model import Corrupt, DeviceEvent, ImuSample, TickClock
from jointfit_drivers.table_samples import RecordSamples, SampleForm, TableRecord

if TYPE_CHECKING:
    from collections.abc import Sequence

MS = 1_000_000
SLOTS = (0, 1, 2, 3, 13, 14, 15)
FORM = SampleForm(
    SLOTS,
    (1.0,) * 4,
    (0.0,) * 4,
    100.0,
    TickClock(1000, 1 << 32),
    counts=256,
    world="NED",
)
NATIVE = (0.5, -0.5, 0.1, 0.7)


def record(
    number: int, *, ticks: int | None = None, counter: int | None = None, valid: int = 1
) -> TableRecord:
    ticks = 10_000 * number if ticks is None else ticks
    counter = number % 256 if counter is None else counter
    values = (*NATIVE, ticks % (1 << 32), counter, valid)
    return TableRecord(1_000 * MS + number * 10 * MS, values, 20, (b"",))


def summary(items: Sequence[object]) -> list[object]:
    """Return the ticks of samples, the kinds of events, and the reasons of losses."""
    out: list[object] = []
    for item in items:
        if isinstance(item, ImuSample):
            out.append(item.ticks)
        elif isinstance(item, DeviceEvent):
            out.append((item.kind, item.data.get("lost")))
        elif isinstance(item, Corrupt):
            out.append(item.reason)
    return out


def run(records: list[TableRecord], form: SampleForm = FORM) -> list[object]:
    samples = RecordSamples(form)
    return summary([item for each in records for item in samples.take(each)])


def test_the_orientation_is_canonical_and_the_native_one_is_kept() -> None:
    (sample,) = RecordSamples(FORM).take(record(0))
    assert isinstance(sample, ImuSample)
    assert sample.q_native == NATIVE
    assert sample.q_world_sensor == pytest.approx((0.28284, 0.84853, -0.14142, 0.42426), abs=1e-5)
    assert (sample.ticks, sample.counter, sample.status) == (0, 0, 1)

    inverse = FORM._replace(world="NWU", world_to_sensor=True)
    (sample,) = RecordSamples(inverse).take(record(0))
    assert isinstance(sample, ImuSample)
    assert sample.q_world_sensor == pytest.approx((0.84853, 0.42426, 0.28284, -0.14142), abs=1e-5)


def test_losses_are_counted_across_wraps_of_a_short_counter() -> None:
    sent = [record(number) for number in (*range(20), *range(25, 30), *range(830, 840))]
    lost = [item for item in run(sent) if isinstance(item, tuple)]
    assert lost == [("gap", 5), ("gap", 800)]


@pytest.mark.parametrize("kind", ["counter", "time"])
def test_losses_are_counted_with_one_of_the_two(kind: str) -> None:
    """Losses are counted with the counter alone, and with the time alone."""
    left = 14 if kind == "counter" else 13
    slots = tuple(slot for slot in SLOTS if slot != (27 - left))
    form = FORM._replace(slots=slots, tick_clock=FORM.tick_clock if left == 13 else None)
    drop = 5 if left == 13 else 4
    sent = []
    for number in (*range(20), *range(25, 30)):
        each = record(number)
        sent.append(each._replace(values=each.values[:drop] + each.values[drop + 1 :]))
    assert [item for item in run(sent, form) if isinstance(item, tuple)] == [("gap", 5)]


def test_time_wraps_without_a_restart() -> None:
    start = (1 << 32) - 100_000
    items = run([record(number, ticks=start + 10_000 * number) for number in range(30)])
    assert len(items) == 30
    assert all(isinstance(item, int) for item in items)


def test_a_restart_is_reported_and_no_sample_lost() -> None:
    sent = [record(number) for number in range(50, 80)]
    sent += [record(80 + at, ticks=10_000 * at, counter=at) for at in range(10)]
    items = run(sent)
    assert items[30] == ("restart", None)
    assert items[31:] == [10_000 * at for at in range(10)]


def test_one_corrupt_time_costs_one_sample() -> None:
    sent = [record(number) for number in range(30)]
    sent[20] = record(20, ticks=77_000_000_0)
    items = run(sent)
    assert items[20:23] == ["time and counter disagree with the other samples", ("gap", 1), 210_000]
    assert len([item for item in items if isinstance(item, int)]) == 29


def test_a_silence_with_running_clock_is_a_gap() -> None:
    sent = [record(number) for number in (*range(20), *range(60_020, 60_030))]
    assert [item for item in run(sent) if not isinstance(item, int)] == [("gap", 60_000)]


def test_invalid_samples_and_wrong_norms_are_refused() -> None:
    samples = RecordSamples(FORM._replace(mask=0x06, equals=0x02))
    items = samples.take(record(0, valid=0x04)) + samples.take(record(1, valid=0x0A))
    assert summary(items) == ["the device marks the sample as invalid", 10_000]
    zero = record(2)._replace(values=(0.0, 0.0, 0.0, 0.0, 20_000, 2, 0x02))
    assert summary(samples.take(zero)) == ["quaternion norm is not 1"]
    assert (samples.refused, samples.refused_bytes) == (2, 40)


def test_values_that_are_not_finite_never_raise() -> None:
    samples = RecordSamples(FORM)
    for bad in (float("nan"), float("inf")):
        for place in range(7):
            values = list(record(1).values)
            values[place] = bad
            samples.take(record(1)._replace(values=tuple(values)))
