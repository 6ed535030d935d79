"""Stamping of samples, and rejection of arrival stamps in the future."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.config import load_rig
from jointfit_daemon.model import Chunk, DeviceEvent
from jointfit_daemon.pipeline.sources import SourceState, StampedMeasurement
from jointfit_protocols import xcdi
from jointfit_protocols.can import CanFrame, pack_frames

if TYPE_CHECKING:
    from jointfit_daemon.config import Source

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "knee.toml"
HOUR_NS = 3_600_000_000_000


def can_source() -> Source:
    return next(source for source in load_rig(EXAMPLE).sources if source.id == "S2")


def test_another_unit_of_device_time_after_reopening_is_a_restart_and_settles() -> None:
    state = SourceState.create(can_source())
    events: list[str] = []
    for first, ticks in ((1, 100), (3000, 10_000)):
        state.start()
        for k in range(first, first + 1500):
            t_ns = 5_000_000_000 + k * 10_000_000
            chunk = group(t_ns, t_ns, k, ticks=ticks * (k - first + 1))
            events.extend(
                item.text
                for item in state.feed(chunk)
                if isinstance(item, DeviceEvent) and item.kind == "restart"
            )
        assert state.clock.state == "passive"
        assert state.clock.skew_ppm == pytest.approx(0.0, abs=50.0)
        state.stop()
    assert len(events) == 1


def restarts_after_reopening(pause_s: float, stall_s: float) -> tuple[list[str], int]:
    """Reopen a sensor that continues to count; return restart events and the restart counter.

    The samples of the first `stall_s` after the pause arrive at once, so that the decoder needs
    longer to determine the unit of device time.
    """
    state = SourceState.create(can_source())
    events: list[str] = []
    k, start_ns = 0, 5_000_000_000

    def play(seconds: float, late_until_ns: int = 0) -> None:
        nonlocal k
        for _ in range(round(seconds * 100)):
            k += 1
            t_ns = max(start_ns + k * 10_000_000, late_until_ns)
            events.extend(
                item.text
                for item in state.feed(group(t_ns, t_ns, k))
                if isinstance(item, DeviceEvent) and item.kind == "restart"
            )

    state.start()
    play(20.0)
    state.stop()
    k += round(pause_s * 100)
    state.start()
    play(stall_s, start_ns + k * 10_000_000 + round(stall_s * 1e9))
    play(5.0)
    return events, state.counts.restarts


@pytest.mark.parametrize("pause_s", [0.0, 1.5, 5.0])
@pytest.mark.parametrize("stall_s", [0.0, 0.3, 1.8])
def test_reopened_sensor_that_continued_counting_has_not_restarted(
    pause_s: float, stall_s: float
) -> None:
    assert restarts_after_reopening(pause_s, stall_s) == ([], 0)


def group(t_ns: int, stamp_ns: int, k: int, ticks: int | None = None) -> Chunk:
    ticks = 100 * k if ticks is None else ticks
    quaternion = xcdi.quaternion_counts((1.0, 0.0, 0.0, 0.0))
    frames = [
        CanFrame(stamp_ns, 0x105, xcdi.encode(xcdi.DataId.SAMPLE_TIME, (ticks,))),
        CanFrame(stamp_ns, 0x106, xcdi.encode(xcdi.DataId.GROUP_COUNTER, (k,))),
        CanFrame(stamp_ns, 0x121, xcdi.encode(xcdi.DataId.QUATERNION, quaternion)),
    ]
    return Chunk(t_ns, pack_frames(frames))


def test_arrival_stamp_in_the_future_is_replaced_by_now() -> None:
    state = SourceState.create(can_source())
    state.start()
    for k in range(1, 40):
        t_ns = 5_000_000_000 + k * 10_000_000
        ahead = HOUR_NS if k == 20 else 0
        for item in state.feed(group(t_ns, t_ns + ahead, k)):
            if isinstance(item, StampedMeasurement):
                assert item.measurement.arrival_ns <= t_ns
                assert item.stamp.t_ns <= t_ns + 1_000_000
    assert state.counts.received == 39
