"""Real processes, clocks that drift and begin anew: no frame calls itself synced and is not."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from bench.restarts import EVERY, live
from bench.stamp_truth import OPTICAL

if TYPE_CHECKING:
    from pathlib import Path

    from tests.broker_fixture import MosquittoBroker

pytestmark = pytest.mark.system

MOST_ERROR_NS = 500_000


@pytest.mark.timeout(90)
async def test_time_is_right_in_every_frame_that_says_so(
    tmp_path: Path, mosquitto: MosquittoBroker
) -> None:
    found = await live(tmp_path, mosquitto.port, ("S1", OPTICAL), rest_s=1.0)
    assert found.replayed
    assert found.unknown < 0.01
    for source in EVERY:
        errors = found.errors_ns(source)
        assert len(errors) > 200, source
        assert max(map(abs, errors)) <= MOST_ERROR_NS, source
    frames = found.frame_errors_ns
    assert len(frames) > 300
    assert max(frames) <= MOST_ERROR_NS


@pytest.mark.timeout(90)
async def test_before_a_clock_has_settled_its_error_may_be_anything(
    tmp_path: Path, mosquitto: MosquittoBroker
) -> None:
    """And the judge sees it: or it would prove nothing of those that have."""
    found = await live(tmp_path, mosquitto.port, (), rest_s=0.5)
    unsynced = [s.error_ns for s in found.core.samples if not s.synced and s.error_ns is not None]
    assert max(map(abs, unsynced)) > MOST_ERROR_NS
