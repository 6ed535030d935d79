"""`jointfit fuse` processes unusual input correctly, or names the faulty object and the remedy."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from jointfit_daemon.files.orientations import (
    OrientationTrial,
    read_orientations_npz,
    write_orientations_npz,
)
from jointfit_daemon.kinematics import rotation
from tests.tools.fuse.fuse_files import (
    LIMB,
    MARKER_OPTIONS,
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
    from pathlib import Path


@pytest.fixture
def files(tmp_path: Path) -> Path:
    return write_trials(tmp_path)


def errors(files: Path, *names: str) -> dict[tuple[str, str], Any]:
    """Return the errors of every method on trials of the folder, by trial and method."""
    options = [*LIMB, "--static", files / "still.npz", "--json"]
    result = run("evaluate", *(files / f"{name}.npz" for name in names), *options)
    assert result.exit_code == 0, result.output
    return {key: row["segments_rms"] for key, row in rows(result).items()}


def rewrite(files: Path, name: str, trial: OrientationTrial) -> None:
    write_orientations_npz(files / f"{name}.npz", trial)


def test_q_and_minus_q_mixed_at_random_change_nothing(files: Path) -> None:
    before = errors(files, "m0", "m1")
    rng = np.random.default_rng(5)
    for k in range(2):
        trial = movement(k)
        signs = {name: rng.choice([-1.0, 1.0], (N, 1)) for name in (*trial.sensors, *trial.bones)}
        sensors = {name: signs[name] * q for name, q in trial.sensors.items()}
        bones = {name: signs[name] * q for name, q in trial.bones.items()}
        rewrite(files, f"m{k}", OrientationTrial(trial.t_s, sensors, bones, {}))
    for key, found in errors(files, "m0", "m1").items():
        assert found == pytest.approx(before[key], abs=1e-9), key


def test_a_reference_missing_half_of_the_time_suffices_for_training(files: Path) -> None:
    for k in range(2):
        trial = movement(k)
        for q in trial.bones.values():
            q[np.arange(N) // 10 % 2 == 1] = np.nan
        rewrite(files, f"h{k}", trial)
    found = errors(files, "h0", "h1", "m2")
    for segment in ("thigh", "shank"):
        assert found["m2", "anchored"][segment] < 0.7 * found["m2", "mean"][segment]
    frames = rows(run("evaluate", files / "h0.npz", files / "m1.npz", *LIMB, "--json"))
    assert frames["h0", "mean"]["frames"] == N // 2  # the frames with a reference


def test_trial_without_evaluation_frames_is_reported(files: Path) -> None:
    trial = movement()
    trial.bones["shank"][N // 2 :] = np.nan
    rewrite(files, "begun", trial)
    text = said(run("evaluate", files / "begun.npz", *LIMB, "--static", files / "still.npz"))
    assert "shank: 0 complete frames in the held-out part of begun" in text
    assert "--holdout" in text


def test_sensor_without_samples_is_named(files: Path) -> None:
    trial = movement()
    trial.sensors["B"][:] = np.nan
    rewrite(files, "m0", trial)
    text = said(run("evaluate", *trials(files), *LIMB, "--static", files / "still.npz"))
    assert "m0.npz: B: no orientation in the whole trial" in text
    assert "--segment" in text


def test_a_sensor_unplugged_half_of_the_time_suffices_for_training(files: Path) -> None:
    trial = movement(0)
    trial.sensors["B"][N // 2 :] = np.nan
    rewrite(files, "m0", trial)
    found = errors(files, "m0", "m1", "m2")
    assert found["m1", "anchored"]["thigh"] < 0.5 * found["m1", "mean"]["thigh"]


def test_identical_sensors_are_fitted_and_reported(files: Path) -> None:
    for k in range(3):
        trial = movement(k)
        turned = rotation.exp(np.array((0.1, 0.4, -0.2)))
        trial.sensors["B"][:] = rotation.multiply(trial.sensors["A"], turned)
        rewrite(files, f"m{k}", trial)
    result = run("evaluate", *trials(files), *LIMB, "--json")
    assert "A and B do not move relative to each other" in result.stderr
    assert "C and D" not in result.stderr
    for key, row in rows(result).items():
        assert np.isfinite([*row["segments_rms"].values()]).all(), key
        if key[1] == "anchored":
            assert row["segments_rms"]["thigh"] < 0.1, key


@pytest.mark.parametrize("command", ["evaluate", "fit"])
def test_fit_without_movement_is_rejected(files: Path, command: str) -> None:
    out = ["--out", files / "model.json"] if command == "fit" else []
    text = said(run(command, files / "still.npz", *LIMB, *out))
    assert "knee rotates by only 0.0 deg" in text
    assert "--method mean" in text


def test_the_mean_needs_no_movement(files: Path) -> None:
    out = ["--method", "mean", "--out", files / "model.json"]
    assert run("fit", files / "still.npz", *LIMB, *out).exit_code == 0


def test_trial_without_reference_is_rejected_with_a_remedy(files: Path) -> None:
    trial = movement(1)
    rewrite(files, "m1", OrientationTrial(trial.t_s, trial.sensors, {}, {}))
    text = said(run("evaluate", *trials(files, 2), *LIMB))
    assert "m1.npz: no reference of segment 'thigh'" in text
    assert "SENSORS=REFERENCE" in text


def test_sensors_and_bones_of_one_name_are_kept_apart(files: Path) -> None:
    """A sensor and a bone of one file may both have the name ``thigh``."""
    trial = movement()
    sensors = {"thigh": trial.sensors["A"], "shank": trial.sensors["C"]}
    rewrite(files, "same", OrientationTrial(trial.t_s, sensors, trial.bones, {}))
    same = ["--segment", "thigh=thigh", "--segment", "shank=shank", "--json"]
    found = rows(run("evaluate", files / "same.npz", *same))
    assert found["same", "mean"]["segments_rms"]["shank"] > np.deg2rad(1.0)


def test_trials_with_equal_stems_are_distinguished_and_duplicates_rejected(files: Path) -> None:
    (files / "other").mkdir()
    other = files / "other" / "m0.npz"
    write_orientations_npz(other, movement(1))
    found = rows(run("evaluate", files / "m0.npz", other, *LIMB, "--json"))
    assert {trial for trial, _ in found} == {str(files / "m0.npz"), str(other)}
    text = said(run("evaluate", files / "m0.npz", files / "m0.npz", *LIMB))
    assert "given more than once" in text


def test_a_file_may_hold_the_reference_alone(files: Path) -> None:
    trial = movement()
    held = {f"q_{name}": q for name, q in trial.bones.items()}
    np.savez(files / "bones.npz", t=trial.t_s, up="z", **held)  # type: ignore[arg-type]
    result = run("evaluate", f"{files}/m0.npz={files}/bones.npz", *LIMB, "--json")
    assert result.exit_code == 0, result.output


def test_arrays_of_wrong_shape_are_reported_by_name(files: Path) -> None:
    with np.load(files / "m0.npz", allow_pickle=False) as found:
        held = {name: found[name] for name in found.files}
    for odd in (held["A_quat"][:-5], held["A_quat"][:, :3]):
        np.savez(files / "odd.npz", **{**held, "A_quat": odd})
        text = said(run("evaluate", files / "odd.npz", *LIMB))
        assert f"A_quat has shape {odd.shape}, expected (200, 4)" in text


@pytest.mark.parametrize("length", [0, 100, 5000])
def test_truncated_file_is_reported_by_name(files: Path, length: int) -> None:
    whole = (files / "m0.npz").read_bytes()
    assert len(whole) > length
    (files / "cut.npz").write_bytes(whole[:length])
    text = said(run("evaluate", files / "cut.npz", *LIMB))
    assert "cut.npz: not an NPZ file, or cut off" in text


def test_four_zeros_are_a_gap_and_no_complaint(files: Path) -> None:
    trial = movement()
    trial.sensors["B"][50] = 0.0
    rewrite(files, "zero", trial)
    assert np.isnan(read_orientations_npz(files / "zero.npz").sensors["B"][50]).all()


def test_scalar_last_quaternions_are_pointed_out(files: Path) -> None:
    trial = movement()
    trial.sensors["B"][:] = trial.sensors["B"][:, [1, 2, 3, 0]]
    rewrite(files, "m0", trial)
    result = run("evaluate", *trials(files), *LIMB, "--static", files / "still.npz")
    assert "warning: m0: B is" in result.stderr
    assert "from the reference of thigh; check that quaternions are scalar first" in result.stderr


def test_moving_static_trial_is_rejected_with_sensor_names(files: Path) -> None:
    trial = movement()
    rewrite(files, "moving", OrientationTrial(trial.t_s, trial.sensors, {}, {}))
    text = said(run("evaluate", files / "m0.npz", *LIMB, "--static", files / "moving.npz"))
    assert "in a static trial" in text
    assert "C " in text


def pairs(files: Path, *names: str) -> list[str]:
    return [f"{files}/{name}.npz={files}/{name}.trc" for name in names]


def test_mounts_of_a_json_may_go_with_still_markers(files: Path) -> None:
    for name, trial in (("m0", movement(0)), ("still", still())):
        as_trc(files / f"{name}.trc", trial)
    mounts = {name: rotation.conjugate(q[0]).tolist() for name, q in still().sensors.items()}
    text = f'{{"q_bias": {mounts}, "up": "z"}}'.replace("'", '"')
    (files / "mounts.json").write_text(text)
    static = ["--static", f"{files}/mounts.json={files}/still.trc", "--json"]
    by_json = run("evaluate", *pairs(files, "m0"), *LIMB, *MARKER_OPTIONS, *static)
    static = ["--static", *pairs(files, "still"), "--json"]
    by_trial = run("evaluate", *pairs(files, "m0"), *LIMB, *MARKER_OPTIONS, *static)
    assert by_json.exit_code == 0, by_json.output
    for key, row in rows(by_trial).items():
        assert rows(by_json)[key]["segments_rms"] == pytest.approx(row["segments_rms"], abs=1e-3)


def test_implausible_marker_extent_is_rejected(files: Path) -> None:
    for name, trial in (("m0", movement(0)), ("still", still())):
        as_trc(files / f"{name}.trc", trial, scale=1000.0)
    static = ["--static", *pairs(files, "still")]
    text = said(run("evaluate", *pairs(files, "m0"), *LIMB, *MARKER_OPTIONS, *static))
    assert "check the units stated in the file" in text


def test_swapped_markers_are_reported_as_such(files: Path) -> None:
    as_trc(files / "still.trc", still())
    as_trc(files / "m0.trc", movement(0), stretch=2.0)
    static = ["--static", *pairs(files, "still")]
    text = said(run("evaluate", *pairs(files, "m0"), *LIMB, *MARKER_OPTIONS, *static))
    assert "differ from the static trial: check for swapped names" in text


def test_missing_sensor_can_be_ignored(files: Path) -> None:
    model = ["--static", files / "still.npz", "--out", files / "model.json"]
    assert run("fit", *trials(files, 2), *LIMB, *model).exit_code == 0
    trial = movement(2)
    worn = {name: q for name, q in trial.sensors.items() if name != "B"}
    rewrite(files, "worn", OrientationTrial(trial.t_s, worn, {}, {}))
    out = ["--out", files / "out.npz"]
    text = said(run("apply", files / "model.json", files / "worn.npz", *out))
    assert "no sensor 'B'" in text
    assert "to ignore it: --without B" in text
    result = run("apply", files / "model.json", files / "worn.npz", *out, "--without", "B")
    assert "Only one sensor of thigh contributes (one_sensor:thigh): 100 %" in result.stdout
    found = read_orientations_npz(files / "out.npz").bones["thigh"]
    assert np.isfinite(found).all()
    text = said(run("apply", files / "model.json", files / "m2.npz", *out, "--without", "b"))
    assert "did you mean 'B'?" in text


def test_unknown_markers_are_reported_with_suggestions(files: Path) -> None:
    as_trc(files / "still.trc", still())
    as_trc(files / "m0.trc", movement(0))
    names = [*MARKER_OPTIONS[:-1], "shank=shank0,shank1,shnak2"]
    static = ["--static", *pairs(files, "still")]
    text = said(run("evaluate", *pairs(files, "m0"), *LIMB, *names, *static))
    assert "'shnak2': did you mean 'shank2'" in text
