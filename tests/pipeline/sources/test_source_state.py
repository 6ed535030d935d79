"""Stamping of samples, and rejection of arrival stamps in the future."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from jointfit_daemon.config import load_rig
from jointfit_daemon.model import Chunk
from jointfit_daemon.pipeline.sources import SourceState, StampedMeasurement
from jointfit_protocols import xcdi
from jointfit_protocols.can import CanFrame, pack_frames

if TYPE_CHECKING:
    from jointfit_daemon.config import Source

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "knee.toml"
HOUR_NS = 3_600_000_000_000


def can_source() -> Source:
    return next(source for source in load_rig(EXAMPLE).sources if source.id == "S2")


def group(t_ns: int, stamp_ns: int, k: int) -> Chunk:
    quaternion = xcdi.quaternion_counts((1.0, 0.0, 0.0, 0.0))
    frames = [
        CanFrame(stamp_ns, 0x105, xcdi.encode(xcdi.DataId.SAMPLE_TIME, (100 * k,))),
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
