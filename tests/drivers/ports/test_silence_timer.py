"""The timer for the silence of a device, on a loop whose time the test sets."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pytest

from jointfit_drivers.ports._silence_timer import SilenceTimer

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass
class _Timer:
    when_s: float
    callback: Callable[[], None]
    is_cancelled: bool = False

    def cancel(self) -> None:
        self.is_cancelled = True


class _ManualLoop:
    """Event loop with timers only."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.timers: list[_Timer] = []

    def time(self) -> float:
        return self.now_s

    def call_at(self, when_s: float, callback: Callable[[], None]) -> _Timer:
        self.timers.append(_Timer(when_s, callback))
        return self.timers[-1]

    def run_until(self, until_s: float) -> None:
        while due := [t for t in self.timers if t.when_s <= until_s and not t.is_cancelled]:
            first = min(due, key=lambda timer: timer.when_s)
            first.cancel()
            self.now_s = first.when_s
            first.callback()
        self.now_s = until_s


@pytest.fixture
def loop(monkeypatch: pytest.MonkeyPatch) -> _ManualLoop:
    made = _ManualLoop()
    monkeypatch.setattr(asyncio, "get_running_loop", lambda: made)
    return made


def test_a_device_is_silent_one_interval_after_its_last_arrival(loop: _ManualLoop) -> None:
    silent_s: list[float] = []
    timer = SilenceTimer(1.0, lambda: silent_s.append(loop.now_s))

    for arrival_s in (0.4, 0.9, 1.7):
        loop.run_until(arrival_s)
        timer.note_arrival()

    loop.run_until(2.6)
    assert silent_s == []
    loop.run_until(10.0)
    assert silent_s == pytest.approx([2.7])


def test_arrivals_set_no_timer(loop: _ManualLoop) -> None:
    timer = SilenceTimer(1.0, pytest.fail)

    for step in range(1, 4001):  # ten seconds at 400 Hz
        loop.run_until(step / 400)
        timer.note_arrival()

    assert len(loop.timers) <= 12


def test_a_longer_first_wait_ends_with_the_first_arrival(loop: _ManualLoop) -> None:
    silent_s: list[float] = []
    timer = SilenceTimer(1.0, lambda: silent_s.append(loop.now_s), first_s=30.0)

    loop.run_until(5.0)
    timer.note_arrival()
    loop.run_until(40.0)

    assert silent_s == pytest.approx([6.0])


def test_without_an_arrival_the_first_wait_is_the_limit(loop: _ManualLoop) -> None:
    silent_s: list[float] = []
    SilenceTimer(1.0, lambda: silent_s.append(loop.now_s), first_s=3.0)

    loop.run_until(40.0)

    assert silent_s == [3.0]


def test_a_cancelled_timer_stays_silent_after_an_arrival(loop: _ManualLoop) -> None:
    timer = SilenceTimer(1.0, pytest.fail, first_s=9.0)

    timer.cancel()
    timer.note_arrival()

    loop.run_until(40.0)
