"""Three early samples, or two seconds of samples with equal lateness, are a clock fault."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.timing.clock._plausibility import PlausibilityMonitor

if TYPE_CHECKING:
    from jointfit_daemon.timing.clock._clock_events import ClockEvent

MS = 1_000_000


def run(
    monitor: PlausibilityMonitor, excesses_ms: list[float], sigma_ms: float = 0.1
) -> list[tuple[int, ClockEvent]]:
    """Feed a sample every 10 ms; return the events with the number of their sample."""
    found = [
        (number, monitor.feed(excess * MS, sigma_ms * MS, number * 10 * MS))
        for number, excess in enumerate(excesses_ms)
    ]
    return [(number, event) for number, event in found if event is not None]


def test_three_early_samples_in_a_row_are_a_jump() -> None:
    ((number, event),) = run(PlausibilityMonitor(), [-6.0, -6.0, 0.0, -6.0, -6.0, -6.5])
    assert number == 5
    assert event.data == {"jump_ms": 6.5}


def test_before_the_first_sample_nothing_is_implausible() -> None:
    assert not PlausibilityMonitor().any


@pytest.mark.parametrize("excess_ms", [-5.0, 0.0, 49.9])
def test_samples_within_the_limits_are_plausible(excess_ms: float) -> None:
    monitor = PlausibilityMonitor()
    assert run(monitor, [excess_ms] * 400) == []
    assert not monitor.any
    assert monitor.early == 0


def test_evenly_late_samples_are_reported_after_two_seconds() -> None:
    monitor = PlausibilityMonitor()
    (first, *_) = run(monitor, [60.0, *[50.0] * 400])
    assert first[0] == 200
    assert first[1].data == {"jump_ms": -50.0}
    assert "for 2 s" in first[1].text
    assert monitor.any


@pytest.mark.parametrize(
    ("excesses_ms", "reported"),
    [
        ([55.0] * 50 + [50.0] * 350, True),  # the fastest samples agree to 5 ms
        ([55.1] * 50 + [50.0] * 151, False),
        ([100.0, 50.0] * 200, True),  # mean delay above the fastest: 25 ms
        ([101.0, 50.0] * 200, False),
        ([50.0] * 150 + [0.0] + [50.0] * 199, False),  # a plausible sample ends the lateness
        ([50.0] * 150 + [-6.0] + [50.0] * 60, True),  # an early sample does not end the lateness
    ],
)
def test_lateness_is_a_fault_only_if_the_fastest_samples_agree(
    excesses_ms: list[float], reported: bool
) -> None:
    assert bool(run(PlausibilityMonitor(), excesses_ms)) is reported


def test_lateness_is_measured_against_the_uncertainty_of_the_clock() -> None:
    assert run(PlausibilityMonitor(), [59.9] * 400, sigma_ms=3.0) == []
    assert run(PlausibilityMonitor(), [60.0] * 400, sigma_ms=3.0)
