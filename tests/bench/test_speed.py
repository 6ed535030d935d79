"""The speed bench runs, tells goals beside figures, and fails where a floor is missed."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from bench.framework.measurement import Bench, Row, as_json, as_text, fixed_loop, percentile
from bench.speed import main
from tests.broker_fixture import MOSQUITTO_MISSING

if TYPE_CHECKING:
    from typing import Any

PROJECT = Path(__file__).resolve().parents[2]


def measured(tmp_path: Path, pattern: str, timeout_s: float = 28.0) -> dict[str, Any]:
    """Run the command on some benches; return the figures by name, unless a floor was missed."""
    found = tmp_path / "speed.json"
    words = ["--quick", "--rows", pattern, "--json", str(found)]
    ran = subprocess.run(
        [sys.executable, str(PROJECT / "bench" / "speed.py"), *words],
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    told: dict[str, Any] = json.loads(found.read_text(encoding="utf-8"))
    assert told["machine"]["python"]
    return {row["name"]: row for bench in told["benches"] for row in bench["rows"]}


@pytest.mark.alone
def test_codecs_keep_their_floors_and_slcan_is_several_times_cheaper_than_python_cans(
    tmp_path: Path,
) -> None:
    rows = measured(tmp_path, "xbus|xcdi|natnet|slcan|clock|align")
    assert len(rows) == 11
    assert rows["slcan: ours over python-can's"]["figure"] < 0.5


@pytest.mark.alone
@pytest.mark.experiment
@pytest.mark.timeout(60)
def test_a_frame_keeps_its_floor(tmp_path: Path) -> None:
    rows = measured(tmp_path, "fusion|core", 55.0)
    assert {row["unit"] for row in rows.values()} == {"µs"}
    assert all(row["ratio"] > 0 for row in rows.values())


@pytest.mark.alone
@pytest.mark.experiment
@pytest.mark.system
@pytest.mark.timeout(90)
def test_the_daemon_is_measured_between_hardware_and_broker(tmp_path: Path) -> None:
    rows = measured(tmp_path, "gateway100", 85.0)
    if "4 × 100 Hz: latency, p99" not in rows:
        pytest.skip(MOSQUITTO_MISSING)
    assert rows["4 × 100 Hz: samples unaccounted for"]["figure"] == 0
    assert 0 < rows["4 × 100 Hz: latency, median"]["figure"] < 200


def test_a_missed_floor_ends_with_1_and_a_missed_goal_does_not(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [Row("slow", 5.0, "µs", 1.0, 10.0)]
    bench = Bench("one", "a bench", lambda _: rows)
    monkeypatch.setattr("bench.speed.find_benches", lambda: [bench])
    monkeypatch.setattr("sys.argv", ["speed.py"])
    assert main() == 0
    assert "goal missed" in capsys.readouterr().out
    rows.append(Row("slower", float("nan"), "µs", 1.0, 10.0))
    assert main() == 1
    assert "floors missed: slower" in capsys.readouterr().err


def test_an_unknown_bench_is_a_usage_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["speed.py", "--rows", "no such"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2


def test_figures_are_told_to_people_and_programs() -> None:
    row = Row("a", 1.5, "ms", 2.0, 8.0, 0.25, "of three")
    assert "1.5 ms" in as_text([row])
    told = as_json([(Bench("b", "c", lambda _: [row]), [row])])["benches"][0]["rows"][0]
    assert told["reached"]
    assert not told["missed"]
    assert (told["figure"], told["goal"], told["ratio"]) == (1.5, 2.0, 0.25)


def test_a_percentile_is_a_value_that_was_measured() -> None:
    values = [float(k) for k in range(100)]
    assert percentile(values[::-1], 0.99) == 99.0
    assert percentile(values, 0.5) == 50.0
    assert percentile([7.0], 0.99) == 7.0
    assert fixed_loop() == fixed_loop()
