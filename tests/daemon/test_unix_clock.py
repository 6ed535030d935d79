"""UNIX time set while the daemon runs: followed, told once, and frames keep their order."""

from __future__ import annotations

import itertools
import time
from typing import TYPE_CHECKING, Any

import orjson
import pytest

from jointfit_daemon.config import parse_rig
from jointfit_daemon.model import LimbState
from jointfit_daemon.outputs.outbox import Outbox
from jointfit_daemon.outputs.reporter import Reporter
from jointfit_daemon.outputs.unix_clock import UnixClock

if TYPE_CHECKING:
    from collections.abc import Callable

S, MS = 1_000_000_000, 1_000_000
BEGIN_UNIX_NS = 1_795_250_000 * S


class Host:
    """Both clocks of a host: monotonic time goes on by itself, UNIX time can be set."""

    def __init__(self) -> None:
        self.now_ns, self.offset_ns = 5_000 * S, BEGIN_UNIX_NS - 5_000 * S
        self.wait_ns: Callable[[], int] = lambda: 100

    def monotonic_ns(self) -> int:
        self.now_ns += self.wait_ns()
        return self.now_ns

    def time_ns(self) -> int:
        return self.monotonic_ns() + self.offset_ns


@pytest.fixture
def host(monkeypatch: pytest.MonkeyPatch) -> Host:
    host = Host()
    monkeypatch.setattr(time, "monotonic_ns", host.monotonic_ns)
    monkeypatch.setattr(time, "time_ns", host.time_ns)
    return host


def test_the_unix_clock_keeps_the_spacing_of_stamps(host: Host) -> None:
    clock = UnixClock()
    before = clock.offset_ns()
    host.offset_ns += 3_600 * S
    assert clock.offset_ns() == before
    assert before == pytest.approx(BEGIN_UNIX_NS - 5_000 * S, abs=1_000)


@pytest.mark.parametrize("step_s", [3_600.0, -3_600.0, 0.01, -0.01])
def test_a_step_is_followed_within_a_second_and_told_once(host: Host, step_s: float) -> None:
    clock = UnixClock()
    before = clock.offset_ns()
    host.offset_ns += round(step_s * S)
    host.now_ns += S
    assert clock.offset_ns() - before == pytest.approx(step_s * S, abs=1_000)
    assert clock.take_step_ns() == pytest.approx(step_s * S, abs=1_000)
    assert clock.take_step_ns() == 0


def test_a_busy_machine_is_no_step(host: Host) -> None:
    waits = iter([100, 20 * MS, 100, 100, 30 * MS] * 100)
    host.wait_ns = lambda: next(waits)
    clock = UnixClock()
    for _ in range(5):
        clock.offset_ns()
        host.now_ns += S
    assert clock.take_step_ns() == 0


async def sent(outbox: Outbox) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    while outbox.queued:
        message, done = await outbox.next()
        done()
        found.setdefault(message.topic.removeprefix("b/"), []).append(
            orjson.loads(message.payload) if message.payload else None
        )
    return found


async def test_poses_across_a_step_back_keep_their_order_and_the_step_is_an_event(
    table: dict[str, Any], host: Host, caplog: pytest.LogCaptureFixture
) -> None:
    outbox = Outbox("b/bridge/state")
    reporter = Reporter(parse_rig(table | {"mqtt": {"base": "b"}}), outbox)
    poses: list[dict[str, Any]] = []
    events: list[dict[str, Any]] = []
    for number in range(400):
        if number == 200:
            host.offset_ns -= 3_600 * S
        host.now_ns += 10 * MS
        t_ns = host.now_ns - 5 * MS
        reporter.handle(LimbState(number, t_ns, t_ns, "imu", "locked", (), (), ()))
        found = await sent(outbox)
        poses += found.get("pose", [])
        events += found.get("bridge/event", [])
    steps = [b["t_us"] - a["t_us"] for a, b in itertools.pairwise(poses)]
    assert sum(step < 0 for step in steps) == 1
    assert sum(step for step in steps if step < 0) == pytest.approx(-3_600e6, abs=20_000)
    mono = [b["mono_us"] - a["mono_us"] for a, b in itertools.pairwise(poses)]
    assert min(mono) > 9_900
    assert max(mono) < 10_100
    assert all(pose["age_ms"] < 6 for pose in poses)
    (event,) = events
    assert (event["kind"], event["id"], event["level"]) == ("clock", "host", "warning")
    assert event["text"] == "UNIX time was set back by 3600.000 s"
    assert event["data"] == {"step_s": pytest.approx(-3600.0, abs=1e-5)}
    assert caplog.text.count("set back") == 1
