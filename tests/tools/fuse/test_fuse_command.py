"""`jointfit fuse` evaluates, fits and applies methods to files, and rejects wrong files."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from jointfit_daemon.calibration.soft_tissue import METHODS
from jointfit_daemon.files.orientations import (
    OrientationTable,
    OrientationTrial,
    read_orientations_npz,
    read_orientations_sto,
    read_sto,
    write_orientations_npz,
    write_orientations_sto,
)
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import Calibration
from tests.tools.fuse.fuse_files import (
    LIMB,
    MARKER_OPTIONS,
    RATE_HZ,
    N,
    as_trc,
    movement,
    rows,
    run,
    said,
    still,
    trials,
    write_trials,
)

if TYPE_CHECKING:
    from collections.abc import Callable


def test_every_method_is_evaluated_on_every_held_out_trial(files: Path) -> None:
    result = run("evaluate", *trials(files), *LIMB, "--static", files / "still.npz", "--json")
    found = rows(result)
    methods = {method for _, method in found}
    learned = {"anchored", "patent12", "patent6", "markley"}
    assert methods == learned | {"mean", "single A+C", "single B+D"}
    assert {trial for trial, _ in found} == {"m0", "m1", "m2"}
    for trial in ("m0", "m1", "m2"):
        best, mean = found[trial, "anchored"], found[trial, "mean"]
        assert best["segments_rms"]["thigh"] < 0.5 * mean["segments_rms"]["thigh"]


def test_a_single_trial_is_evaluated_on_its_last_part(files: Path) -> None:
    options = ["--static", files / "still.npz", "--holdout", "0.25", "--json"]
    result = run("evaluate", files / "m1.npz", *LIMB, *options)
    assert json.loads(result.stdout)["judged_on"].startswith("the last 25 %")
    assert {row["frames"] for row in rows(result).values()} == {50}


def test_evaluation_uses_frames_that_were_not_fitted(files: Path) -> None:
    """A wrong reference in one trial gives a large error, because other trials train the model."""
    spoiled = movement(2)
    turned = rotation.multiply(spoiled.bones["thigh"], rotation.exp(np.array((1.0, 0, 0))))
    write_orientations_npz(
        files / "m2.npz",
        OrientationTrial(spoiled.t_s, spoiled.sensors, {**spoiled.bones, "thigh": turned}, {}),
    )
    options = [*LIMB, "--static", files / "still.npz", "--json"]
    found = rows(run("evaluate", *trials(files), *options))
    assert found["m2", "anchored"]["segments_rms"]["thigh"] > 0.8


def test_evaluation_compares_methods_with_the_mean(files: Path) -> None:
    result = run("evaluate", *trials(files), *LIMB, "--static", files / "still.npz")
    assert result.exit_code == 0
    assert "knee flexion" in result.stdout
    assert "anchored is not worse than mean" in result.stdout


def test_the_semireal_squats_reproduce_their_published_figures(shared_data: Path) -> None:
    """The RMS errors of thigh, shank and knee flexion, deg, are those in the README of the data."""
    folder = shared_data / "semireal_knee4imu"
    result = run(
        "evaluate", folder / "squats1.npz", "--segment", "thigh=S1,S2:femur_r",
        "--segment", "shank=S3,S4:tibia_r", "--joints", "hip,knee,ankle",
        "--static", folder / "static_bias.json", "--json",
    )  # fmt: skip
    found = rows(result)
    published = {
        "single S1+S3": (10.46, 10.39, 2.56),
        "mean": (9.29, 9.61, 3.21),
        "patent12": (3.45, 2.81, 2.11),
        "patent6": (5.37, 3.83, 4.21),
    }
    for method, expected in published.items():
        row = found["squats1", method]
        figures = [*row["segments_rms"].values(), *row["flexion_rms"].values()]
        assert np.rad2deg(figures) == pytest.approx(expected, abs=0.05), method


@cache
def model_text(folder: Path, method: str) -> str:
    """Return the text of the model that `method` yields for the three trials in `folder`."""
    static = ["--static", folder / "still.npz", "--method", method]
    result = run("fit", *trials(folder), *LIMB, *static, "--out", folder / "fit.json")
    assert result.exit_code == 0, result.output
    return (folder / "fit.json").read_text()


@pytest.fixture(scope="module")
def three_trials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_trials(tmp_path_factory.mktemp("trials"))


@pytest.fixture
def files(three_trials: Path, tmp_path: Path) -> Path:
    """Return a private folder with the three movements and the static pose."""
    return Path(shutil.copytree(three_trials, tmp_path / "files"))


@pytest.fixture
def fitted(three_trials: Path, files: Path) -> Callable[..., Path]:
    """Return a function that writes a fitted model next to the trials."""

    def write(method: str = "anchored") -> Path:
        (files / "model.json").write_text(model_text(three_trials, method))
        return files / "model.json"

    return write


def test_a_model_is_a_calibration_with_a_model_for_every_set_of_sensors(
    files: Path, fitted: Callable[..., Path]
) -> None:
    calibration = Calibration.from_dict(json.loads(fitted().read_text()))
    assert calibration.chain_sensors == (("A", "B"), ("C", "D"))
    for segment, others in (("thigh", "CD"), ("shank", "AB")):
        keys = set(calibration.segment[segment].models)
        assert len(keys) == 12
        assert {key.partition("|")[2] for key in keys} == {"", "+".join(others), *others}


def test_a_fitted_model_applied_is_nearer_to_the_bones_than_the_mean(
    files: Path, fitted: Callable[..., Path]
) -> None:
    truth = movement(1)
    errors = {}
    for method in ("anchored", "mean"):
        model = fitted(method)
        result = run("apply", model, files / "m1.npz", "--out", files / "out.npz")
        assert result.exit_code == 0, result.output
        found = read_orientations_npz(files / "out.npz").bones["shank"]
        errors[method] = float(np.mean(rotation.angle_between(found, truth.bones["shank"])))
    assert errors["anchored"] < 0.4 * errors["mean"]


@pytest.mark.parametrize("method", METHODS)
def test_every_method_may_be_fitted_and_applied(
    files: Path, fitted: Callable[..., Path], method: str
) -> None:
    result = run("apply", fitted(method), files / "m1.npz", "--out", files / "out.npz")
    assert result.exit_code == 0, result.output
    assert "shank: known in 100 %" in result.stdout


def test_three_output_formats_have_equal_content(files: Path, fitted: Callable[..., Path]) -> None:
    model = fitted()
    for ending in ("npz", "sto", "csv"):
        result = run("apply", model, files / "m0.npz", "--out", files / f"out.{ending}")
        assert result.exit_code == 0, result.output
    with np.load(files / "out.npz", allow_pickle=False) as arrays:
        thigh, angles, sd = arrays["q_thigh"], arrays["angles_knee"], arrays["sd_thigh"]
    sto = read_orientations_sto(files / "out.sto")
    assert sto.names == ("thigh", "shank")
    assert sto.quaternions[:, 0] == pytest.approx(thigh, abs=1e-7)
    second = read_sto(files / "out_angles.sto")
    assert second.in_degrees
    assert second.column("knee_flexion") == pytest.approx(np.rad2deg(angles[:, 0]), abs=1e-4)
    with (files / "out.csv").open() as text:
        first = next(csv.DictReader(text))
    assert float(first["knee_flexion_deg"]) == pytest.approx(np.rad2deg(angles[0, 0]), abs=1e-6)
    assert float(first["thigh_sd_deg"]) == pytest.approx(np.rad2deg(sd[0]), abs=1e-6)
    assert float(first["thigh_qw"]) == pytest.approx(thigh[0, 0], abs=1e-8)


def test_a_bent_knee_is_positive_flexion(files: Path, fitted: Callable[..., Path]) -> None:
    run("apply", fitted(), files / "m2.npz", "--out", files / "out.npz")
    with np.load(files / "out.npz", allow_pickle=False) as arrays:
        assert np.rad2deg(arrays["angles_knee"][:, 0].max()) > 60.0


def test_missing_sensor_is_reported_and_the_others_are_fused(
    files: Path, fitted: Callable[..., Path]
) -> None:
    trial = movement(0)
    trial.sensors["B"][50:100] = np.nan
    write_orientations_npz(files / "gap.npz", trial)
    result = run("apply", fitted(), files / "gap.npz", "--out", files / "out.npz")
    assert "(one_sensor:thigh): 25 %" in result.stdout
    assert "thigh: known in 100 %" in result.stdout


@cache
def figures_of_npz(folder: Path) -> dict[tuple[str, str], Any]:
    """Return the errors of all methods on two trials in `folder`, by trial and method."""
    options = [*LIMB, "--static", folder / "still.npz", "--json"]
    return rows(run("evaluate", *trials(folder, 2), *options))


def as_sto(path: Path, trial: OrientationTrial, *, bones: bool, up: str = "z") -> None:
    """Write the orientations of sensors or bones as an STO file of OpenSim."""
    columns = trial.bones if bones else trial.sensors
    q = np.stack(list(columns.values()), axis=1)
    q = q[..., [0, 2, 3, 1]] if up == "y" else q
    write_orientations_sto(path, OrientationTable(tuple(columns), trial.t_s, q, RATE_HZ))


@pytest.mark.parametrize("up", ["z", "y"])
def test_orientations_and_their_reference_may_be_two_sto_files(
    files: Path, three_trials: Path, up: str
) -> None:
    for name, trial in (("m0", movement(0)), ("m1", movement(1)), ("still", still())):
        as_sto(files / f"{name}.sto", trial, bones=False, up=up)
        as_sto(files / f"{name}_ref.sto", trial, bones=True, up=up)
    pairs = [f"{files}/{name}.sto={files}/{name}_ref.sto" for name in ("m0", "m1", "still")]
    result = run("evaluate", *pairs[:2], *LIMB, "--static", pairs[2], "--up", up, "--json")
    found = rows(result)
    for key, row in figures_of_npz(three_trials).items():
        assert found[key]["segments_rms"] == pytest.approx(row["segments_rms"], abs=1e-5)


def test_markers_at_another_rate_serve_as_the_reference(files: Path, three_trials: Path) -> None:
    for name, trial in (("m0", movement(0)), ("m1", movement(1)), ("still", still())):
        as_trc(files / f"{name}.trc", trial)
    pairs = [f"{files}/{name}.npz={files}/{name}.trc" for name in ("m0", "m1", "still")]
    result = run("evaluate", *pairs[:2], *LIMB, *MARKER_OPTIONS, "--static", pairs[2], "--json")
    assert result.exit_code == 0, result.output
    found = rows(result)
    for key, row in figures_of_npz(three_trials).items():
        assert found[key]["segments_rms"] == pytest.approx(row["segments_rms"], abs=2e-3)


def test_markers_without_a_still_trial_are_refused_with_the_remedy(files: Path) -> None:
    as_trc(files / "m0.trc", movement())
    text = said(run("evaluate", f"{files}/m0.npz={files}/m0.trc", *LIMB))
    assert "--static SENSORS=MARKERS" in text


def test_evaluation_without_static_trial_warns(files: Path) -> None:
    result = run("evaluate", *trials(files), *LIMB)
    assert result.exit_code == 0
    assert "hold for this sensor placement only" in result.stderr


def test_a_plot_is_written(files: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    static = ["--static", files / "still.npz", "--plot", files / "plot.png"]
    arguments = ["fuse", "evaluate", files / "m0.npz", *LIMB, *static]
    subprocess.run(  # in a new process, because matplotlib keeps its fonts open
        [sys.executable, "-m", "jointfit_daemon.tools", *map(str, arguments)],
        check=True,
        timeout=80,
    )
    assert (files / "plot.png").read_bytes().startswith(b"\x89PNG")


WRONG = {
    "sensor": (["--segment", "thigh=A,Bb", "--segment", "shank=C,D"], "did you mean 'B'?"),
    "bone": (["--segment", "thigh=A,B:tigh", "--segment", "shank=C,D"], "did you mean 'thigh'?"),
    "no sensors": (["--segment", "thigh"], "expected NAME=SENSOR,SENSOR"),
    "twice": (["--segment", "thigh=A,B", "--segment", "shank=A,D"], "A appears more than once"),
    "joints": ([*LIMB[:4], "--joints", "hip,knee"], "expected 3 names, one more than segments"),
    "axis": ([*LIMB, "--up", "x"], "expected y or z"),
    "markers": ([*LIMB, "--markers", "tigh=a,b,c"], "did you mean 'thigh'?"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_unknown_names_are_reported_with_suggestions(files: Path, case: str) -> None:
    options, expected = WRONG[case]
    assert expected in said(run("evaluate", files / "m0.npz", *options))


def rewritten(files: Path, **arrays: Any) -> Path:
    with np.load(files / "m0.npz", allow_pickle=False) as found:
        held = {name: found[name] for name in found.files}
    held |= {name: change(held[name]) for name, change in arrays.items()}
    np.savez(files / "odd.npz", **held)
    return files / "odd.npz"


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"A_quat": lambda q: 57.3 * q}, "not angles in degrees"),
        ({"q_shank": lambda q: 0.01 * q}, "q_shank: median norm 0.01"),
        ({"t": lambda t: 1000.0 * t}, "not milliseconds"),
        ({"t": lambda t: t[::-1]}, "row 2 has time 3.96 s after"),
    ],
)
def test_implausible_values_are_rejected(
    files: Path, change: dict[str, Any], expected: str
) -> None:
    assert expected in said(run("evaluate", rewritten(files, **change), *LIMB))


def test_trials_without_common_time_are_reported_with_both_spans(files: Path) -> None:
    late = movement()
    shifted = OrientationTrial(late.t_s + 1000.0, late.sensors, late.bones, {})
    write_orientations_npz(files / "late.npz", shifted)
    text = said(run("evaluate", f"{files}/m0.npz={files}/late.npz", *LIMB))
    assert "reference 1000.00 to 1003.98 s" in text


def test_a_sensor_world_that_is_turned_is_pointed_out(files: Path) -> None:
    found = []
    for k in range(2):
        trial = movement(k, tissue=0.0)
        about_y = rotation.exp(np.array((0.0, 0.8, 0.0))[None] * np.sin(np.arange(N) / 20)[:, None])
        turn = rotation.heading(1.2)
        sensors = {name: rotation.multiply(about_y, q) for name, q in trial.sensors.items()}
        sensors["A"] = rotation.multiply(turn, sensors["A"])
        bones = {name: rotation.multiply(about_y, q) for name, q in trial.bones.items()}
        write_orientations_npz(files / f"t{k}.npz", OrientationTrial(trial.t_s, sensors, bones, {}))
        found.append(files / f"t{k}.npz")
    result = run("evaluate", *found, *LIMB, "--static", files / "still.npz")
    assert "A: its world seems rotated by -69° about the vertical" in result.stderr


def test_unknown_method_is_reported_with_a_suggestion(files: Path) -> None:
    options = ["--static", files / "still.npz", "--out", files / "x.json", "--method", "anchord"]
    assert "did you mean 'anchored'?" in said(run("fit", *trials(files), *LIMB, *options))


def test_invalid_model_and_format_are_rejected(files: Path, fitted: Callable[..., Path]) -> None:
    (files / "no.json").write_text("{}")
    out = ["--out", files / "o.csv"]
    assert "expected a model" in said(run("apply", files / "no.json", files / "m0.npz", *out))
    model = fitted()
    text = said(run("apply", model, files / "m0.npz", "--out", files / "o.txt"))
    assert "ends in .sto, .mot, .npz or .csv" in text
    assert "No such file" in said(run("apply", model, files / "none.npz", *out))
