"""The daemon with a chain model: faulty markers are flagged, and another model is refused."""

from __future__ import annotations

import asyncio
import sys
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.tools.calibrate._phase_tracker import PhaseAbortedError
from tests.system.station import Listener, Station, hang_up, running, stopped

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.tools.child_processes import ChildProcess, Simulator
    from tests.broker_fixture import Broker

pytestmark = [pytest.mark.system, pytest.mark.experiment, pytest.mark.timeout(200)]


async def test_lost_and_exchanged_markers_are_flagged_and_the_rest_is_tracked(
    tmp_path: Path, broker: Broker
) -> None:
    station = Station(tmp_path, broker.port, ("--chain-model",))
    async with running(station) as (simulator, daemon, listener):
        assert listener.client is not None
        await listener.client.subscribe("optical/chain")
        await listener.until(lambda: "optical/chain" in listener.latest)
        faulty, sound = await lose_and_exchange_markers(simulator, listener)
        await reload_another_model(station, daemon, listener)
        code, _ = await stopped(daemon)
        assert code == 0, station.log

    for payload in (faulty, sound):
        assert payload["fit"]["accepted"]
        assert 0.0 < payload["fit"]["rms_m"] < 0.02
        coordinates = payload["coordinates"]
        assert 0.5 < coordinates["pelvis_tz"]["value_m"] < 1.3
        assert -80.0 < coordinates["shank_angle"]["value_deg"] < 25.0
        assert 0.0 < coordinates["shank_angle"]["sd_deg"] < 10.0
    assert faulty["error_m"]["F2"] is None
    assert faulty["error_m"]["T1"] > 0.06


async def lose_and_exchange_markers(
    simulator: Simulator, listener: Listener
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Hide a marker and exchange two labels; return a payload with and one without these faults."""

    def flags() -> list[str]:
        found: list[str] = listener.latest["optical/chain"]["flags"]
        return found

    await simulator.send_command("play walk")
    await simulator.send_command("hide F2")
    await simulator.send_command("exchange T1 T3")
    await listener.until(lambda: {"lost:F2", "exchanged:T1~T3"} <= set(flags()))
    await listener.event("T1", "T1 and T3 look exchanged")

    # Wait for a later frame in which T1 and T3 are visible but excluded from the fit.
    excluded_us = listener.latest["optical/chain"]["t_us"]

    def is_later_with_both(payload: dict[str, Any]) -> bool:
        both = payload["error_m"]["T1"], payload["error_m"]["T3"]
        return bool(payload["t_us"] > excluded_us and None not in both)

    await listener.until(lambda: is_later_with_both(listener.latest["optical/chain"]))
    faulty = listener.latest["optical/chain"]

    # The static phase rejects the exchanged labels.
    await simulator.send_command("play stand")
    exchange = "T1 and T3 look exchanged: T1 is at the place of T3"
    with pytest.raises(PhaseAbortedError, match=exchange):
        await listener.phase("static", 3.0)

    await simulator.send_command("show F2")
    await simulator.send_command("exchange T1 T3")
    await listener.until(lambda: not flags())
    await listener.event("T1", "in use")
    return faulty, listener.latest["optical/chain"]


async def reload_another_model(station: Station, daemon: ChildProcess, listener: Listener) -> None:
    """Check that a model with a marker on another segment is refused and the old model is used."""
    model = station.rig.with_name("leg.toml")
    text = model.read_text()
    thigh = 'name = "T2"\nsegment = "thigh"'
    assert thigh in text
    model.write_text(text.replace(thigh, thigh.replace("thigh", "shank")))
    hang_up(daemon)
    await listener.event(
        "demo", "refused, the running configuration stays in force", "chain.model has T2 on 'shank'"
    )
    refused_us = listener.latest["optical/chain"]["t_us"]
    await listener.until(lambda: listener.latest["optical/chain"]["t_us"] > refused_us)
    assert listener.latest["optical/chain"]["error_m"].keys() >= {"T1", "T2", "T3"}
    model.write_text(text)


async def test_a_model_with_other_markers_stops_the_start_with_their_names(
    tmp_path: Path, broker: Broker
) -> None:
    station = Station(tmp_path, broker.port, ("--chain-model",))
    async with station.simulator():
        pass
    model = tmp_path / "leg.toml"
    model.write_text(model.read_text().replace('name = "T2"', 'name = "X2"'))
    words = ["-m", "jointfit_daemon", "--config", str(station.rig)]
    daemon = await asyncio.create_subprocess_exec(
        sys.executable, *words, stderr=asyncio.subprocess.PIPE
    )
    _, printed = await daemon.communicate()
    assert daemon.returncode == 2
    assert "chain.model: has markers that are not in mocap.markers: X2" in printed.decode()
