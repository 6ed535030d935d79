"""Outcomes of mocap frames: used, idle, and recorded only with a synchronized stamp."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from jointfit_daemon.model import MocapFrame, MocapLayout
from jointfit_daemon.pipeline._mocap_router import MocapRouter
from jointfit_daemon.pipeline.sources import StampedMeasurement
from jointfit_daemon.timing.clock import Stamp


def stamped(*, synced: bool) -> StampedMeasurement:
    nothing = np.zeros((0, 3))
    frame = MocapFrame(5, 1, None, MocapLayout((), ()), nothing, nothing, np.zeros((0, 4)))
    return StampedMeasurement(frame, Stamp(4, 1.0, synced, 0))


@pytest.mark.parametrize(
    ("synced", "collecting", "outcome"),
    [(True, True, "used"), (False, True, "idle"), (True, False, "idle"), (False, False, "idle")],
)
def test_a_phase_records_synchronized_frames_only(
    synced: bool, collecting: bool, outcome: str
) -> None:
    recorded: list[int] = []
    session = SimpleNamespace(
        collecting=collecting, add_mocap=lambda t_ns, _: recorded.append(t_ns)
    )
    router = MocapRouter()
    router.add(5, stamped(synced=synced), cast("Any", session), None, cast("Any", None))
    assert router.counts() == {"used": 0, "idle": 0} | {outcome: 1}
    assert recorded == ([4] if outcome == "used" else [])
    assert router.is_fresh(5)
