"""Requests to the daemon as a process: every payload and answer fits its model."""

from __future__ import annotations

import asyncio
import sys
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from jointfit_daemon.files.mocap import read_trc
from jointfit_daemon.outputs.payload_models import ANSWERS
from tests.payload_check import payload_fault
from tests.system.station import PATIENCE_S, Listener, Station, running
from tests.system.test_calibrated_run import TOPICS

if TYPE_CHECKING:
    from pathlib import Path

    from tests.broker_fixture import Broker

pytestmark = [pytest.mark.system, pytest.mark.experiment, pytest.mark.timeout(240)]

REQUESTS: dict[str, dict[str, object]] = {
    "selftest": {},
    "calibrations": {},
    "mark": {"text": "heel strike"},
    "rate": {"hz": 50.0},
    "restart-device": {"device": "S1"},
    "reload": {},
    "static": {"seconds": 60.0},
    "calibrate": {"phase": "abort"},
}
"""Requests in the order in which they are sent."""


async def test_payloads_and_answers_of_a_running_daemon_fit_their_models(
    tmp_path: Path, broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    misfits: dict[str, str] = {}
    seen: set[str] = set()
    take = Listener._take

    def check(self: Listener, topic: str, payload: Any) -> None:
        seen.add(topic)
        if (misfit := payload_fault(topic, payload)) is not None:
            misfits[topic] = misfit
        take(self, topic, payload)

    monkeypatch.setattr(Listener, "_take", check)
    options = ("--chain-model", "--sensors-hz", "5")
    async with running(Station(tmp_path, broker.port, options, "[recording]\n")) as parts:
        listener = parts[2]
        assert listener.client is not None
        await listener.client.subscribe(*TOPICS)
        for name, arguments in REQUESTS.items():
            if name == "calibrate":
                await listener.until(lambda: "calibration/progress" in seen)
            answer = await listener.client.request(name, arguments, timeout_s=PATIENCE_S)
            assert answer["status"] in ("ok", "accepted"), answer
            assert payload_fault(f"bridge/response/{name}", answer) is None
            ANSWERS[name].model_validate(answer["data"])

        await listener.event("demo", "heel strike")
        await listener.event("S1", "stopped")
        expected = {"pose", "pose/ui", "optical/chain", "sensors/pose", "joint/knee"}
        await listener.until(lambda: seen >= expected)
        await listener.health()
    assert misfits == {}


async def test_a_recording_that_starts_later_contains_the_markers(
    tmp_path: Path, broker: Broker
) -> None:
    """The daemon received the list of marker names before the recording began."""
    async with running(Station(tmp_path, broker.port)) as (_, _, listener):
        await listener.connected(("S1", "S2", "S3", "S4", "mocap"))
        assert listener.client is not None
        await listener.client.request("record", {"action": "start"})
        await asyncio.sleep(2.0)
        answer = await listener.client.request("record", {"action": "stop"})
        assert answer["status"] == "ok", answer
    export = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "jointfit_daemon.tools", "export", "--to", "trc"),
        *(answer["data"]["directory"], "--out", str(tmp_path / "exported")),
        stderr=asyncio.subprocess.PIPE,
    )
    _, errors = await export.communicate()
    assert export.returncode == 0, errors.decode()
    (path,) = (tmp_path / "exported").glob("*.trc")
    markers = read_trc(path)
    assert len(markers.positions) > 100
    assert np.isfinite(markers.positions).mean() > 0.9
