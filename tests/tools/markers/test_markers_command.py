"""`jointfit markers` refines, reports and writes marker positions, and rejects wrong options."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING, Any

import numpy as np
import orjson
import pytest
from typer.testing import CliRunner

from jointfit_daemon.files.mocap import MarkerTrajectories, read_trc, write_trc
from jointfit_daemon.files.models import read_model, write_model
from jointfit_daemon.kinematics.chains import (
    ChainModel,
    Joint,
    Marker,
    Segment,
    apply_step,
    marker_positions,
    rest_state,
)
from jointfit_daemon.tools.__main__ import app

if TYPE_CHECKING:
    from pathlib import Path

run = CliRunner().invoke
TO_Y_UP = [1, 2, 0]


def true_model() -> ChainModel:
    rng = np.random.default_rng(8)
    thigh = Segment("thigh", "pelvis", Joint("ball", (0.1, 0.0, -0.1)))
    shank = Segment("shank", "thigh", Joint("hinge", (0.0, 0.0, -0.4)))
    markers = [
        Marker(f"{name[0].upper()}{k}.x" if k == 3 else f"{name[0].upper()}{k}", name, tuple(at))
        for name in ("pelvis", "thigh", "shank")
        for k, at in enumerate(rng.normal(0.0, 0.1, (4, 3)).tolist())
    ]
    return ChainModel((Segment("pelvis"), thigh, shank), tuple(markers), "leg")


def walked(frames: int, pace: float) -> MarkerTrajectories:
    model, t = true_model(), np.linspace(0.0, 6.0, frames)[:, None]
    move = 0.4 * np.sin(pace * t + np.linspace(0.0, 3.0, model.nq))
    y = marker_positions(model, apply_step(model, rest_state(model, frames), move))
    y += np.random.default_rng(1).normal(0.0, 0.002, y.shape)
    count = np.arange(1, frames + 1)
    return MarkerTrajectories(model.marker_names, t[:, 0], count, y[..., TO_Y_UP], frames / 6.0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    model = true_model()
    off = np.random.default_rng(2).normal(0.0, 0.01, model.positions.shape)
    write_model(tmp_path / "leg.toml", model.with_markers(model.positions + off))
    write_trc(tmp_path / "walk.trc", walked(60, 1.0))
    write_trc(tmp_path / "run.trc", walked(80, 1.7))
    return tmp_path


def asked(folder: Path, *options: str) -> list[str]:
    return ["markers", str(folder / "walk.trc"), "--model", str(folder / "leg.toml"), *options]


def answer(folder: Path, *options: str) -> dict[str, Any]:
    result = run(app, [*asked(folder, *options), "--json"])
    assert result.exit_code == 0, result.stderr
    found: dict[str, Any] = orjson.loads(result.stdout)
    return found


@pytest.mark.parametrize("method", ["joint", "block"])
def test_training_and_validation_trials_are_reported_separately(folder: Path, method: str) -> None:
    found = answer(folder, "--validate", str(folder / "run.trc"), "--method", method)
    walk, ran = found["trials"]
    assert (walk["trained"], ran["trained"]) == (True, False)
    assert walk["after"]["rms_m"] < 0.5 * walk["before"]["rms_m"]
    assert ran["after"]["rms_m"] < 0.7 * ran["before"]["rms_m"]
    assert found["method"] == method


def test_errors_are_compared_with_the_accepted_limits(folder: Path) -> None:
    result = run(app, asked(folder, "--validate", str(folder / "run.trc")))
    lines = [line for line in result.stdout.splitlines() if line.startswith("errors")]
    assert [line.split()[1] for line in lines] == ["training:", "validation:"]
    assert all("below 20 mm" in line for line in lines)

    # With an error of 8 cm of one marker in one frame, the maximum error exceeds its limit, but the
    # RMS error remains below its limit.
    trial = read_trc(folder / "walk.trc")
    trial.positions[30, 1] += 0.08
    write_trc(folder / "walk.trc", trial)
    (walk,) = answer(folder)["trials"]
    assert walk["after"]["maximum_m"] > 0.04 > 2.0 * walk["after"]["rms_m"]
    assert walk["accepted"] is False


def test_coordinate_search_reports_its_inverse_kinematics_runs(folder: Path) -> None:
    found = answer(folder, "--method", "search", "--frames", "10")
    assert found["runs"] > 50
    assert found["trials"][0]["after"]["rms_m"] < found["trials"][0]["before"]["rms_m"]


def test_steps_of_the_coordinate_search_are_options(folder: Path) -> None:
    coarse, fine = (
        answer(folder, "--method", "search", "--frames", "10", "--threshold", threshold)
        for threshold in ("4", "1")
    )
    assert fine["runs"] > coarse["runs"]
    after = [found["trials"][0]["after"]["rms_m"] for found in (coarse, fine)]
    assert after[1] < after[0]


def test_text_report_contains_markers_trials_and_gauge(folder: Path) -> None:
    result = run(app, asked(folder, "--lock", "P0", "--lock", "T3.x.z"))
    assert result.exit_code == 0, result.stderr
    lines = {line.split()[0]: line for line in result.stdout.splitlines() if line}
    assert " xyz " in lines["P0"]
    assert " z " in lines["T3.x"]
    assert "training" in lines["walk"]
    assert "determined by the prior only" in lines["gauge"]
    assert "nan" not in result.stdout


@pytest.mark.parametrize(
    ("options", "remedy"),
    [
        (("--prior", "0"), "lock anatomical markers or set a prior"),
        (("--method", "search"), "markers or use --method joint or block, which have a prior"),
    ],
)
def test_remedy_for_undetermined_markers_is_one_of_the_method(
    folder: Path, options: tuple[str, ...], remedy: str
) -> None:
    result = run(app, asked(folder, "--frames", "10", *options))
    assert result.exit_code == 0, result.stderr
    (line,) = [line for line in result.stdout.splitlines() if line.startswith("gauge")]
    assert "UNDETERMINED" in line
    assert line.endswith(remedy)


def test_a_lock_on_a_marker_with_a_dot_in_its_name_holds_it_whole(folder: Path) -> None:
    """The option `--lock T3.x` locks all coordinates of the marker named T3.x."""
    found = answer(folder, "--lock", "T3.x")
    held = {m["name"]: m["held"] for m in found["markers"]}
    assert held["T3.x"] == [True, True, True]


def test_markers_locked_in_the_model_can_be_freed(folder: Path) -> None:
    model = read_model(folder / "leg.toml")
    write_model(folder / "leg.toml", model.with_locks({"S1": (True, True, True)}))
    held = {m["name"]: m["held"] for m in answer(folder)["markers"]}
    assert all(held["S1"])
    held = {m["name"]: m["held"] for m in answer(folder, "--unlock", "*")["markers"]}
    assert not any(held["S1"])


def test_markers_go_back_in_every_format(folder: Path) -> None:
    outs = [folder / f"new.{kind}" for kind in ("toml", "json", "xml", "trc")]
    found = answer(folder, *(word for out in outs for word in ("--out", str(out))))
    expected = np.array([m["position_m"] for m in found["markers"]])
    before = read_model(folder / "leg.toml").positions
    for out in outs[:2]:
        np.testing.assert_allclose(read_model(out).positions, expected)
    markers = ET.parse(outs[2]).getroot().findall(".//Marker")
    told = [[float(v) for v in m.findtext("location", "").split()] for m in markers]
    np.testing.assert_allclose(told, expected[:, TO_Y_UP], atol=1e-8)
    assert [m.findtext("socket_parent_frame") for m in markers[:1]] == ["/bodyset/pelvis"]
    offsets = read_trc(outs[3])
    assert offsets.names == read_model(folder / "leg.toml").marker_names
    np.testing.assert_allclose(offsets.positions[0], expected - before, atol=1e-8)


def test_opensim_reads_the_marker_set(folder: Path) -> None:
    opensim = pytest.importorskip("opensim", reason="opensim is not installed")
    opensim.Logger.setLevelString("off")
    answer(folder, "--out", str(folder / "new.xml"))
    loaded = opensim.MarkerSet(str(folder / "new.xml"))
    assert loaded.getSize() == len(true_model().markers)


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["--lock", "T3"], 2, ["--lock T3", "did you mean 'T3.x'"]),
        (["--without", "Z"], 2, ["--without Z"]),
        (["--method", "magic"], 2, ["joint, block or search"]),
        (["--out", "new.osim"], 2, [".toml, .json, .xml or .trc"]),
        (["--up", "w"], 2, ["x, y or z"]),
        (
            ["--method", "search", "--threshold", "9"],
            2,
            ["--threshold is 9 mm", "--first-step or less"],
        ),
        (["--first-step", "8"], 2, ["--first-step is for --method search: joint does not use it"]),
        (["--method", "block", "--threshold", "2"], 2, ["--threshold is for --method search"]),
        (["--method", "search", "--prior", "0.5"], 2, ["--prior is for --method joint or block"]),
        (["--method", "search", "--holdout", "0.2"], 2, ["--holdout is for --method joint or b"]),
        (["--method", "search", "--evenness", "1"], 2, ["--evenness is for --method joint or b"]),
        (["--lock", "*"], 1, ["all coordinates are locked"]),
        (["--validate", "nowhere.trc"], 2, ["nowhere.trc"]),
    ],
)
def test_invalid_options_of_the_markers_command_are_rejected_with_a_remedy(
    folder: Path, options: list[str], code: int, words: list[str]
) -> None:
    result = run(app, asked(folder, *options))
    assert result.exit_code == code
    for word in words:
        assert word in result.stderr


def test_millimetres_called_metres_are_refused(folder: Path) -> None:
    wrong = walked(60, 1.0)
    wrong.positions[:] *= 1000.0
    write_trc(folder / "walk.trc", wrong)
    result = run(app, asked(folder))
    assert result.exit_code == 1
    assert "unit" in result.stderr


def test_a_plot_is_drawn(folder: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    command = [sys.executable, "-m", "jointfit_daemon.tools", *asked(folder)]
    done = subprocess.run(  # in a new process, because matplotlib keeps its fonts open
        [*command, "--plot", str(folder / "a.png")], capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert (folder / "a.png").read_bytes().startswith(b"\x89PNG")


def test_weights_of_a_file_exclude_and_include_markers(folder: Path) -> None:
    file = folder / "weights.toml"
    file.write_text("T1 = 0.0\nS1 = 2.0\n", "utf-8")
    moved = {m["name"]: m["moved_m"] for m in answer(folder)["markers"]}
    found = answer(folder, "--weights", str(file))
    now = {m["name"]: m["moved_m"] for m in found["markers"]}
    assert np.linalg.norm(moved["T1"]) > 1e-3
    assert np.linalg.norm(now["T1"]) == 0.0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("T9 = 1.0\n", ("--weights", "T9", "unknown marker")),
        ("T1 = -1.0\n", ("weights.toml", "T1", "0 or more")),
        ('T1 = "much"\n', ("weights.toml", "T1", "expected a number")),
        ("T1 = \n", ("weights.toml",)),
    ],
)
def test_bad_weights_are_an_error_with_the_file_and_the_marker(
    folder: Path, text: str, words: tuple[str, ...]
) -> None:
    file = folder / "weights.toml"
    file.write_text(text, "utf-8")
    result = run(app, asked(folder, "--weights", str(file)))
    assert result.exit_code == 2
    shown = " ".join(result.stderr.split())
    assert all(word in shown for word in words), shown


def test_cost_is_an_option(folder: Path) -> None:
    squares, distances = (answer(folder, "--cost", cost) for cost in ("l2", "l1"))
    assert squares["costs"] != distances["costs"] or squares["markers"] != distances["markers"]
    assert distances["trials"][0]["after"]["rms_m"] < distances["trials"][0]["before"]["rms_m"]
    for options, word in (
        (("--cost", "l3"), "l3"),
        (("--cost", "l1", "--method", "search"), "joint or block"),
    ):
        result = run(app, asked(folder, *options))
        assert result.exit_code == 2
        assert word in result.stderr
