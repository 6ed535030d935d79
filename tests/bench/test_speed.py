"""Speed experiments run as a command, and the command fails if a threshold is missed."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from bench import __main__ as command
from bench.experiments.speed.gateway import _losses
from bench.framework import storage
from bench.framework.experiment import Experiment, Result
from bench.framework.material import SEEDED
from bench.framework.measurement import fixed_loop, machine, percentile, timed_result
from bench.framework.table import text_table
from bench.rigs.gateway import OUTCOMES, Figures, unaccounted
from tests.broker_fixture import MOSQUITTO_MISSING

if TYPE_CHECKING:
    from typing import Any

PROJECT = Path(__file__).resolve().parents[2]


def measured(tmp_path: Path, *ids: str, timeout_s: float = 28.0) -> dict[str, Any]:
    """Run some experiments in short form; return the results by name."""
    found = tmp_path / "speed.json"
    words = [sys.executable, "-m", "bench", *ids, "--quick", "--dry-run", "--json", str(found)]
    ran = subprocess.run(
        words, cwd=PROJECT, capture_output=True, text=True, timeout=timeout_s, check=False
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    contents = json.loads(found.read_text(encoding="utf-8"))
    assert {content["experiment"] for content in contents} == set(ids)
    return {entry["name"]: entry for content in contents for entry in content["results"]}


@pytest.mark.experiment
@pytest.mark.alone
def test_codecs_keep_their_thresholds_and_slcan_is_several_times_cheaper_than_python_cans(
    tmp_path: Path,
) -> None:
    rows = measured(
        tmp_path,
        "xbus-codec",
        "can-codec",
        "natnet-codec",
        "slcan-python-can",
        "clock-time",
        "frame-alignment-time",
    )
    assert len(rows) == 16
    assert rows["slcan: time ratio of jointfit to python-can"]["value"] < 0.5


@pytest.mark.alone
@pytest.mark.experiment
@pytest.mark.timeout(60)
def test_fusion_and_core_keep_their_thresholds(tmp_path: Path) -> None:
    rows = measured(tmp_path, "fusion-frame-time", "core-step-time", timeout_s=55.0)
    assert {row["unit"] for row in rows.values()} == {"µs"}
    assert all(row["ratio"] > 0 for row in rows.values())


@pytest.mark.alone
@pytest.mark.experiment
@pytest.mark.timeout(90)
def test_input_and_run_time_keep_their_thresholds(tmp_path: Path) -> None:
    rows = measured(tmp_path, "can-input-time", "growth-run-time", "weak-gateway", timeout_s=85.0)
    assert rows["SLCAN input, one frame: time ratio to python-can Notifier"]["value"] < 1.0
    times = [row["value"] for row in rows.values() if row["unit"] == "ms/s"]
    assert times[-1] < 0.5 * times[0]


def test_dropped_samples_are_accounted_for_and_listed_separately() -> None:
    outcomes = dict.fromkeys(OUTCOMES, 0) | {"used": 7, "dropped": 3}
    devices = {"S1": {"received": 10, **outcomes}}
    assert unaccounted({"S1": 10}, devices) == 0
    assert unaccounted({"S1": 12}, devices) == 2
    figures = Figures([], 1.0, 0.1, 0.1, 0.0, 80.0, 0, 3, 10, 1.0, 1.0)
    assert [(row.name, row.value) for row in _losses("run", figures)] == [
        ("run: samples unaccounted for", 0),
        ("run: samples dropped", 3),
    ]


@pytest.mark.alone
@pytest.mark.experiment
@pytest.mark.system
@pytest.mark.timeout(90)
def test_daemon_is_measured_between_hardware_and_broker(tmp_path: Path) -> None:
    rows = measured(tmp_path, "gateway-hundred-hertz", timeout_s=85.0)
    if "4 × 100 Hz: latency, p99" not in rows:
        pytest.skip(MOSQUITTO_MISSING)
    assert rows["4 × 100 Hz: samples unaccounted for"]["value"] == 0
    assert "4 × 100 Hz: samples dropped" in rows
    assert 0 < rows["4 × 100 Hz: latency, median"]["value"] < 200


@pytest.mark.alone
@pytest.mark.experiment
@pytest.mark.system
@pytest.mark.timeout(120)
def test_poses_keep_their_latency_during_a_flood_of_invalid_requests(tmp_path: Path) -> None:
    """The 99th percentile is at most 20 ms, or three times the value without requests."""
    rows = measured(tmp_path, "gateway-request-flood", timeout_s=115.0)
    if not rows:
        pytest.skip(MOSQUITTO_MISSING)
    quiet_ms = rows["4 × 100 Hz, same run without requests: latency, p99"]["value"]
    flooded_ms = rows["4 × 100 Hz, 10000 invalid requests in 10 s: latency, p99"]["value"]
    assert flooded_ms <= max(20.0, 3.0 * quiet_ms)


@pytest.mark.alone
@pytest.mark.experiment
@pytest.mark.system
@pytest.mark.timeout(120)
def test_the_dashboard_is_small_and_ten_viewers_change_nothing_for_the_daemon(
    tmp_path: Path,
) -> None:
    rows = measured(tmp_path, "dashboard-viewers", "dashboard-page", timeout_s=115.0)
    if not rows:
        pytest.skip(MOSQUITTO_MISSING)
    assert rows["dashboard server, ten viewers: memory"]["value"] < 40
    if "page: transferred" in rows:
        assert rows["page: transferred"]["value"] < 300


def test_missed_threshold_ends_with_1_and_missed_target_does_not(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    results = [timed_result("slow", 5.0, "µs", 1.0, 10.0)]
    experiment = Experiment("one-experiment", "An experiment", lambda _: results, SEEDED)
    monkeypatch.setattr("bench.framework.experiment._TOPICS", {experiment.id: "timing"})
    monkeypatch.setattr(command, "find_experiments", lambda: [experiment])
    assert command.main(["--dry-run"]) == 0
    assert "target missed" in capsys.readouterr().out
    results.append(timed_result("slower", float("nan"), "µs", 1.0, 10.0))
    assert command.main(["--dry-run"]) == 1
    assert "one-experiment: slower" in capsys.readouterr().err


def test_unknown_experiment_is_a_usage_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["no-such", "--dry-run"]) == 2
    assert "no experiment no-such" in capsys.readouterr().err


def test_results_are_printed_and_stored_alike(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = timed_result("a", 1.5, "ms", 2.0, 8.0, ratio=0.25, note="of three")
    experiment = Experiment("one-experiment", "An experiment", lambda _: [result], SEEDED)
    monkeypatch.setattr("bench.framework.experiment._TOPICS", {experiment.id: "timing"})
    assert "1.500 ms" in text_table([(experiment, [result])])
    storage.store(experiment.id, storage.to_json(experiment, [result]), tmp_path)
    stored = storage.load(experiment.id, tmp_path)
    assert storage.results_of(stored) == [result]
    endless = Result("b", float("inf"))
    stored = storage.to_json(experiment, [endless])
    assert storage.results_of(json.loads(json.dumps(stored))) == [endless]


def test_machine_is_described() -> None:
    assert machine()["python"]


def test_percentile_is_a_measured_value() -> None:
    values = [float(k) for k in range(100)]
    assert percentile(values[::-1], 0.99) == 99.0
    assert percentile(values, 0.5) == 50.0
    assert percentile([7.0], 0.99) == 7.0
    assert fixed_loop() == fixed_loop()
