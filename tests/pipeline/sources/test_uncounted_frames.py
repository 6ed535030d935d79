"""Frames of a server without frame numbers: a delayed frame does not restart the clock."""

from __future__ import annotations

import tomllib

from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.config import parse_rig
from jointfit_daemon.model import Chunk, DeviceEvent
from jointfit_daemon.pipeline.sources import SourceState
from jointfit_protocols import vrpn
from jointfit_protocols.vrpn import SenderDescription, TrackerPose, TypeDescription, encode
from tests.fake_drivers import SMALLEST_RIG

RIG = SMALLEST_RIG.format(port=1883).replace(
    'driver = "fake"\nport = "a"', 'driver = "xbus"\nport = "/dev/null"'
)
CAMERAS = """
[mocap]
driver = "vrpn"
server = "127.0.0.1"
up_axis = "z"
rigid_body.thigh = "Thigh"
"""
OPENING = b"".join(
    [
        encode(vrpn.Cookie()),
        encode(TypeDescription(4, vrpn.POS_QUAT)),
        encode(SenderDescription(1, "Thigh")),
    ]
)
PERIOD_US = 8_333
T0_US = 1_700_000_000_000_000


@given(st.lists(st.integers(0, 3), min_size=1, max_size=20))
def test_frames_stamped_in_bursts_have_one_clock(bursts: list[int]) -> None:
    """VRPN stamps a report when the server creates it; a stalled server creates several at once."""
    rig = parse_rig(tomllib.loads(RIG + CAMERAS))
    state = SourceState.create(next(s for s in rig.sources if s.kind == "mocap"))
    state.start()
    items = state.feed(Chunk(5_000_000_000, OPENING))
    made_us, late = 0, 0
    for n in range(600):
        if late == 0 and n % 10 == 0:
            late = bursts[(n // 10) % len(bursts)]
        due_us = n * PERIOD_US + late * PERIOD_US  # the server was stalled, and catches up
        late = max(0, late - 1)
        made_us = max(made_us + 300, due_us)
        pose = TrackerPose(T0_US + made_us, 1, 0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0)
        items += state.feed(Chunk(5_000_000_000 + made_us * 1000, encode(pose, {vrpn.POS_QUAT: 4})))

    events = [i for i in items if isinstance(i, DeviceEvent) and i.kind in {"clock", "restart"}]
    assert events == []
    assert state.counts.received > 590
    assert state.clock.state != "settling"
