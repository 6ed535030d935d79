"""`jointfit center-study` prints tables with all limitations, and writes figures and JSON."""

from __future__ import annotations

import re
import subprocess
import sys
from typing import TYPE_CHECKING

import orjson
import pytest
from typer.testing import CliRunner

from jointfit_daemon.tools.__main__ import app
from jointfit_daemon.tools.center_study.tables import CAVEATS

if TYPE_CHECKING:
    from pathlib import Path

run = CliRunner().invoke
SHORT = ["center-study", "--repeats", "4"]


@pytest.mark.experiment
def test_study_contains_its_setup_both_tables_and_every_limitation(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    out = tmp_path / "made" / "here"
    asked = [*SHORT, "--seed", "7", "--out", str(out), "--json", str(tmp_path / "a.json")]
    result = subprocess.run(  # in a new process, because matplotlib keeps its fonts open
        [sys.executable, "-m", "jointfit_daemon.tools", *asked],
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    assert result.returncode == 0, result.stderr
    for words in ("±5 cm in steps of 5 mm", "5 to 175°, 35 values", "RMS of 4 runs", "seed      7"):
        assert words in result.stdout
    for text in CAVEATS:
        assert text in result.stdout
    cells = re.findall(r"-?\d\.\d\d/-?\d\.\d\d", result.stdout)
    # Table 1 is printed for two positions of the grid. Each table has three pairs of parameters.
    # The rows of a pair are the published value and the values for five clipping limits.
    assert len(cells) == 2 * 3 * (1 + 5)
    assert (out / "cor-study.txt").read_text("utf-8") == result.stdout
    for name in ("cor-study-figure-2", "cor-study-estimators"):
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert b"<svg" in (out / f"{name}.svg").read_bytes()[:2000]
    found = orjson.loads((tmp_path / "a.json").read_bytes())
    assert found["setup"]["seed"] == 7
    assert [pair["name"] for pair in found["pairs"]] == ["α–σ", "r–σ", "r–α"]
    assert len(found["pairs"][0]["rms_m"]["three frames"]) == 35
    assert "Reuleaux and helical axis: both markers" in result.stdout
    assert "Repetition of small angles" in result.stdout
    assert len(found["radius"]["error_ratio"]) == len(found["radius"]["radii_m"])
    for errors_m in found["median_error_m"].values():
        assert len(errors_m) == 35


def test_without_matplotlib_the_tables_still_print(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("matplotlib", "matplotlib.figure", "matplotlib.backends.backend_agg"):
        monkeypatch.setitem(sys.modules, name, None)
    result = run(app, [*SHORT, "--out", str(tmp_path)])
    assert result.exit_code == 0
    assert "Table 1" in result.stdout
    assert "pip install 'jointfitd[plot]'" in result.stderr
    assert (tmp_path / "cor-study.txt").exists()


def test_a_missing_folder_of_the_results_is_reported_and_nothing_is_created(tmp_path: Path) -> None:
    result = run(
        app, [*SHORT, "--out", str(tmp_path / "a"), "--json", str(tmp_path / "b" / "x.json")]
    )
    assert result.exit_code == 2
    assert "does not exist: create it (mkdir -p)" in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    result = run(app, [*SHORT, "--out", str(tmp_path / "file" / "x")])
    assert result.exit_code == 2
    assert "file" in result.stderr
