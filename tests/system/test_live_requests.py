"""Requests to the daemon as a process: every payload and answer fits its model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

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
