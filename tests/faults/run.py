"""Runs fault scenarios, stores their results, and writes docs/reliability.md from them."""

from __future__ import annotations

import importlib
import json
import statistics
import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jointfit_daemon.outputs.mqtt import NoAnswerError
from tests.endurance.slopes import RESULTS as ENDURANCE
from tests.endurance.slopes import outcomes_of, table_of
from tests.faults.gateway import running_gateway
from tests.faults.peer_table import RESULTS as PEERS
from tests.faults.peer_table import table_of as peer_table_of
from tests.load.table import RESULTS as LOAD
from tests.load.table import table_of as load_table_of
from tests.mutation.score import RESULTS as MUTATION
from tests.mutation.score import text_of as mutation_text_of

if TYPE_CHECKING:
    from tests.broker_fixture import Broker
    from tests.faults.gateway import Gateway
    from tests.faults.scenario import Outcome, Scenario

FOLDER = Path(__file__).parent
RESULTS = FOLDER / "results.json"
PAGE = FOLDER.parents[1] / "docs" / "reliability.md"
TEMPLATE = FOLDER / "page.md"


def scenarios() -> dict[str, Scenario]:
    """Return all scenarios by the name of their file."""
    names = sorted(path.stem for path in (FOLDER / "scenarios").glob("[a-z]*.py"))
    found = (importlib.import_module(f"tests.faults.scenarios.{name}") for name in names)
    return {name: module.SCENARIO for name, module in zip(names, found, strict=True)}


async def run_all(
    folder: Path,
    broker: Broker,
    names: list[str],
    repeat: int,
    outcomes: dict[str, list[Outcome]],
) -> list[str]:
    """Run scenarios, each `repeat` times in a row; add the outcomes of each.

    Scenarios with the same kind of gateway share a daemon, because a fault must have no lasting
    effect. After a failure, another daemon is started.

    Returns
    -------
    list of str
        The failures.
    """
    known, waiting, failures = scenarios(), deque[str](), []
    for name in names:
        if (reason := known[name].missing()) is None:
            waiting.append(name)
        else:
            print(f"{name}: skipped: {reason}", flush=True)

    waiting = deque(sorted(waiting, key=lambda name: known[name].kind))
    while waiting:
        kind = known[waiting[0]].kind
        place = folder / f"{len(waiting)}"
        place.mkdir()
        name = "gateway"
        try:
            async with running_gateway(place, broker, kind) as gateway:
                while waiting and known[waiting[0]].kind == kind:
                    name = waiting.popleft()
                    found = outcomes.setdefault(name, [])
                    await _run_repeatedly(name, known[name], gateway, repeat, found)
        except (AssertionError, TimeoutError, NoAnswerError) as error:
            outcomes.pop(name, None)
            failures.append(f"{name}: {error}")
            print(f"{name}: failed", flush=True)
            if name == "gateway":
                break
    return failures


async def _run_repeatedly(
    name: str, scenario: Scenario, gateway: Gateway, repeat: int, found: list[Outcome]
) -> None:
    began_s = time.monotonic()
    for _ in range(repeat):
        outcome = await scenario.run(gateway)
        found.append(outcome)  # at once, for the results of an interrupted series
    recovered_s = statistics.median(outcome.recovered_s for outcome in found)
    took_s = time.monotonic() - began_s
    print(f"{name}: recovered in {recovered_s:.2f} s (median); took {took_s:.0f} s", flush=True)


def summary(outcomes: list[Outcome]) -> dict[str, Any]:
    """Return the stored figures of one scenario."""
    noticed = [outcome.noticed_s for outcome in outcomes]
    recovered = [outcome.recovered_s for outcome in outcomes]
    return {
        "runs": len(outcomes),
        "noticed_median_s": round(statistics.median(noticed), 3),
        "noticed_most_s": round(max(noticed), 3),
        "recovered_median_s": round(statistics.median(recovered), 3),
        "recovered_most_s": round(max(recovered), 3),
        "pose_gap_most_s": round(max(outcome.pose_gap_s for outcome in outcomes), 3),
        "lost_most": max(outcome.lost for outcome in outcomes),
    }


def render(results: dict[str, Any]) -> str:
    """Return the page."""
    rows = [
        "| fault | runs | noticed, s: median, maximum (limit) | reported | continues |"
        " recovered, s: median, maximum (limit) | largest loss | lost, and where counted |",
        "| --- | --: | --: | --- | --- | --: | --: | --- |",
    ]
    for name, scenario in scenarios().items():
        found = results["scenarios"].get(name)
        if found is None:
            continue
        limit = f"({scenario.noticed_limit_s:g})"
        noticed = f"{found['noticed_median_s']:.2f}, {found['noticed_most_s']:.2f} {limit}"
        if found["noticed_most_s"] == 0.0:
            noticed = "–"
        recovered = f"{found['recovered_median_s']:.2f}, {found['recovered_most_s']:.2f}"
        rows.append(
            f"| {scenario.title} | {found['runs']} | {noticed} | {scenario.reported} |"
            f" {scenario.continues} | {recovered} ({scenario.recovered_limit_s:g}) |"
            f" {found['lost_most']} | {scenario.counted} |"
        )
    machine = f"Machine: {results['machine']}."
    template = TEMPLATE.read_text("utf-8")
    page = template.replace("{table}", "\n".join(rows)).replace("{machine}", machine)
    endurance = json.loads(ENDURANCE.read_text("utf-8"))
    samples = f"{endurance['samples']:,}".replace(",", " ")
    factor = f"{endurance['factor']} times real time"
    page = page.replace("{samples}", samples).replace("{factor}", factor)
    page = page.replace("{variant}", endurance["variant"])
    page = page.replace("{outcomes}", outcomes_of(endurance))
    load = json.loads(LOAD.read_text("utf-8"))
    page = page.replace("{minutes}", f"{load['seconds'] / 60.0:g}")
    page = page.replace("{load}", load_table_of(load))
    page = page.replace("{peers}", peer_table_of(json.loads(PEERS.read_text("utf-8"))))
    page = page.replace("{mutation}", _mutation())
    return page.replace("{slopes}", table_of(endurance))


def _mutation() -> str:
    """Return the score of the stored mutants, if there are any."""
    if not MUTATION.exists():
        return "No complete run is stored yet."
    return mutation_text_of(json.loads(MUTATION.read_text("utf-8")))


def stored() -> dict[str, Any]:
    """Return the stored results."""
    found: dict[str, Any] = json.loads(RESULTS.read_text("utf-8"))
    return found
