"""The daemon reports every fault and recovers within limits; the page has the stored results."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from tests.faults.peer_table import RESULTS as PEERS
from tests.faults.peer_table import slower_than_a_peer
from tests.faults.run import PAGE, render, run_all, scenarios, stored
from tests.system.station import load_factor

if TYPE_CHECKING:
    from pathlib import Path

    from tests.broker_fixture import Broker
    from tests.faults.scenario import Outcome

QUICK = ("broker_killed", "rebooted_sensor", "unplugged_sensor", "zero_byte_reads")
"""Scenarios for the suite; ``make faults`` runs all."""


def test_the_page_shows_the_stored_result_of_every_scenario() -> None:
    results = stored()
    assert results["scenarios"].keys() == scenarios().keys()
    assert PAGE.read_text("utf-8") == render(results)


def test_stored_results_are_within_the_limits() -> None:
    for name, scenario in scenarios().items():
        found = stored()["scenarios"][name]
        assert found["noticed_most_s"] <= scenario.noticed_limit_s, name
        assert found["recovered_most_s"] <= scenario.recovered_limit_s, name


def test_no_other_program_recovers_sooner_in_the_stored_results() -> None:
    assert slower_than_a_peer(json.loads(PEERS.read_text("utf-8"))) == []


@pytest.mark.experiment
@pytest.mark.system
@pytest.mark.timeout(300)
async def test_quick_faults_are_overcome_within_their_limits(
    tmp_path: Path, broker: Broker
) -> None:
    outcomes: dict[str, list[Outcome]] = {}
    failures = await run_all(tmp_path, broker, list(QUICK), 1, outcomes)
    exceeded = failures + [
        text
        for name, found in outcomes.items()
        for outcome in found
        for text in scenarios()[name].faults(outcome, 2.0 * load_factor())
    ]
    assert exceeded == []
