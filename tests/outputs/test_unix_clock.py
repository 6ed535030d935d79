"""Steps of UNIX time during operation: `UnixClock` follows, and the frames remain in order."""

from __future__ import annotations

import asyncio
import itertools
import time
from typing import TYPE_CHECKING, Any

import orjson
import pytest

from jointfit_daemon.config import parse_rig
from jointfit_daemon.model import FusionMode, LimbState, SyncState
from jointfit_daemon.outputs.mqtt import Outbox
from jointfit_daemon.outputs.payloads import TopicWriter
from jointfit_daemon.outputs.unix_clock import UnixClock
from jointfit_daemon.pipeline.events import UnixOffset
from jointfit_daemon.pipeline.health import CoreHealth
from jointfit_daemon.supervisor._core_runner import CoreRunner

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.pipeline.events import Event, Output
    from jointfit_daemon.pipeline.stage_observer import StageObserver

S, MS = 1_000_000_000, 1_000_000
BEGIN_UNIX_NS = 1_795_250_000 * S


class SuspendedHost:
    """Both clocks of a host. Monotonic time advances by itself, and UNIX time can be set."""

    def __init__(self) -> None:
        self.now_ns, self.offset_ns = 5_000 * S, BEGIN_UNIX_NS - 5_000 * S
        self.wait_ns: Callable[[], int] = lambda: 100

    def monotonic_ns(self) -> int:
        self.now_ns += self.wait_ns()
        return self.now_ns

    def time_ns(self) -> int:
        return self.monotonic_ns() + self.offset_ns


@pytest.fixture
def host(monkeypatch: pytest.MonkeyPatch) -> SuspendedHost:
    host = SuspendedHost()
    monkeypatch.setattr(time, "monotonic_ns", host.monotonic_ns)
    monkeypatch.setattr(time, "time_ns", host.time_ns)
    return host


def test_unix_clock_preserves_intervals_of_stamps(host: SuspendedHost) -> None:
    clock = UnixClock()
    before = clock.offset_ns()
    host.offset_ns += 3_600 * S
    assert clock.offset_ns() == before
    assert before == pytest.approx(BEGIN_UNIX_NS - 5_000 * S, abs=1_000)


@pytest.mark.parametrize("step_s", [3_600.0, -3_600.0, 0.01, -0.01, 0.0002])
def test_step_is_followed_within_a_second(host: SuspendedHost, step_s: float) -> None:
    clock = UnixClock()
    before = clock.offset_ns()
    host.offset_ns += round(step_s * S)
    host.now_ns += S
    assert clock.offset_ns() - before == pytest.approx(step_s * S, abs=1_000)
    assert clock.offset_ns() == pytest.approx(before + step_s * S, abs=1_000)


def test_slow_clock_readings_are_no_step(host: SuspendedHost) -> None:
    waits = iter([100, 20 * MS, 100, 100, 30 * MS] * 100)
    host.wait_ns = lambda: next(waits)
    clock = UnixClock()
    offsets = set()
    for _ in range(5):
        offsets.add(clock.offset_ns())
        host.now_ns += S
    assert len(offsets) == 1


async def sent(outbox: Outbox) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    while outbox.queued:
        message, done = await outbox.next()
        done()
        found.setdefault(message.topic.removeprefix("b/"), []).append(
            orjson.loads(message.payload) if message.payload else None
        )
    return found


async def test_mono_us_is_monotonic_across_a_step_of_unix_time(
    table: dict[str, Any], host: SuspendedHost
) -> None:
    outbox = Outbox("b/bridge/state")
    reporter = TopicWriter(parse_rig(table | {"mqtt": {"base": "b"}}), outbox, UnixClock())
    poses: list[dict[str, Any]] = []
    for number in range(400):
        if number == 200:
            host.offset_ns -= 3_600 * S
        host.now_ns += 10 * MS
        t_ns = host.now_ns - 5 * MS
        reporter.output(LimbState(number, t_ns, t_ns, FusionMode.IMU, SyncState.LOCKED, (), (), ()))
        poses += (await sent(outbox)).get("pose", [])
    steps = [b["t_us"] - a["t_us"] for a, b in itertools.pairwise(poses)]
    assert sum(step < 0 for step in steps) == 1
    assert sum(step for step in steps if step < 0) == pytest.approx(-3_600e6, abs=20_000)
    mono = [b["mono_us"] - a["mono_us"] for a, b in itertools.pairwise(poses)]
    assert min(mono) > 9_900
    assert max(mono) < 10_100
    assert all(pose["age_ms"] < 6 for pose in poses)


class Listening:
    """A core that stores its input and returns nothing."""

    def __init__(self) -> None:
        self.heard: list[Event] = []
        self.next_deadline_ns = None
        self.stages: StageObserver | None = None

    def feed(self, event: Event) -> list[Output]:
        self.heard.append(event)
        return []

    def descriptions(self) -> dict[str, tuple[bytes, ...]]:
        return {}

    def health(self, now_ns: int) -> CoreHealth:  # noqa: ARG002 - the shape of a core
        return CoreHealth()


async def test_core_receives_the_unix_offset_first_and_after_each_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The core runs in the real core runner; the host's clock is set 0.3 s after the start."""
    set_ns = 0
    true_unix_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: true_unix_ns() + set_ns)
    core = Listening()
    running = asyncio.create_task(CoreRunner(core, UnixClock()).run(), name="core runner")
    await asyncio.sleep(0.3)
    set_ns = -3_600 * S
    await asyncio.sleep(1.5)
    running.cancel()
    await asyncio.wait([running])
    assert isinstance(core.heard[0], UnixOffset)
    told = [event.offset_ns for event in core.heard if isinstance(event, UnixOffset)]
    assert len(told) == 2
    assert told[1] - told[0] == pytest.approx(-3_600 * S, abs=MS)
