"""`jointfit fuse apply` writes correct joint positions, and the joint angles of the patent.

The tests compute the expected values with SciPy rotations and with explicit quaternion products.
The patent is CN 114533039 B.
"""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jointfit_daemon.calibration.phases import OfflineTrial, fit_offline
from jointfit_daemon.calibration.record import CalibrationStore
from jointfit_daemon.files.orientations import (
    OrientationTrial,
    read_sto,
    write_orientations_npz,
)
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.model import Chain
from jointfit_daemon.tools.fuse._output import chain_of, fuse_trial
from jointfit_daemon.tools.fuse._tables import OrientationRecording
from tests.tools.fuse.fuse_files import LIMB, N, movement, run, said, still, write_trials

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import Calibration

KNEE = Chain(("hip", "knee", "ankle"), ("thigh", "shank"), (("A", "B"), ("C", "D")))
LENGTHS = ["--length", "thigh=0.42", "--length", "shank=0.4"]


@cache
def mean_model(lengths: tuple[tuple[str, float], ...] = ()) -> Calibration:
    """Return a calibration whose segments have the mean orientation of their two sensors."""
    trial = movement()
    mounts = {sensor: np.array(rotation.IDENTITY) for sensor in "ABCD"}
    offline = OfflineTrial("m", trial.t_s, trial.sensors, trial.bones)
    return fit_offline(
        KNEE, [offline], mounts, "mean", lengths={name: (m, 0.01) for name, m in lengths}
    )


def recorded(thigh: Array, shank: Array) -> OrientationRecording:
    """Return a recording at 100 Hz in which sensors have the orientations of their segments."""
    q = {"A": thigh, "B": thigh, "C": shank, "D": shank}
    return OrientationRecording(np.arange(len(thigh)) / 100.0, q, {})


def product(a: Array, b: Array) -> Array:
    """Return the Hamilton product, computed component by component."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a.T, b.T
    return np.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        axis=1,
    )


def below(origin: Array, q: Array, length: float) -> Array:
    """Return the position of the distal joint, P + q (0, 0, 0, -L) q* (step S5 of the patent).

    P is the position `origin` of the proximal joint, q the orientation of the segment with z from
    distal to proximal, and L its length.
    """
    along = np.tile((0.0, 0.0, 0.0, -length), (len(q), 1))
    return origin + product(product(q, along), q * (1.0, -1.0, -1.0, -1.0))[:, 1:]


def euler(above: Array, distal: Array) -> Array:
    """Return the angles alpha, beta, gamma of a joint, rad, shape (N, 3).

    The joint rotation is R = Rz(gamma) Ry(beta) Rx(alpha).
    """
    joint = Rotation.from_quat(above[:, [1, 2, 3, 0]]).inv() * Rotation.from_quat(
        distal[:, [1, 2, 3, 0]]
    )
    return joint.as_euler("ZYX")[:, ::-1]


@settings(max_examples=10, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    lengths=st.tuples(st.floats(0.05, 1.0), st.floats(0.05, 1.0)),
    origin=st.tuples(*[st.floats(-5.0, 5.0)] * 3),
)
def test_positions_are_segments_rotated_by_their_quaternions(
    seed: int, lengths: tuple[float, float], origin: tuple[float, float, float]
) -> None:
    rng = np.random.default_rng(seed)
    swing = np.linspace(0.0, 1.0, 20)[:, None] * rng.normal(size=(2, 1, 3))
    thigh, shank = rotation.exp(swing)
    given_m = dict(zip(KNEE.segments, lengths, strict=True))
    chain = chain_of(mean_model(), left=False, lengths=given_m, origin=origin)
    found = fuse_trial(mean_model(), recorded(thigh, shank), chain)

    q1, q2 = found.segments["thigh"], found.segments["shank"]
    knee = below(np.array(origin), q1, lengths[0])
    assert found.positions["hip"].position == pytest.approx(np.tile(origin, (20, 1)))
    assert found.positions["knee"].position == pytest.approx(knee, abs=1e-12)
    ankle = below(knee, q2, lengths[1])
    assert found.positions["ankle"].position == pytest.approx(ankle, abs=1e-12)
    assert found.positions["ankle"].position == pytest.approx(
        below(below(np.array(origin), thigh, lengths[0]), shank, lengths[1]), abs=1e-9
    )


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_angles_of_the_patent_are_those_of_the_rotation_sequence_z_y_x(seed: int) -> None:
    rng = np.random.default_rng(seed)
    thigh, shank = rotation.exp(np.linspace(0.0, 1.0, 20)[:, None] * rng.normal(size=(2, 1, 3)))
    found = fuse_trial(mean_model(), recorded(thigh, shank), KNEE)
    knee = found.angles["knee"]
    expected = euler(found.segments["thigh"], found.segments["shank"])
    away = np.abs(np.sin(expected[:, 1])) < 0.999
    assert knee.patent[away, :3] == pytest.approx(expected[away], abs=1e-9)
    assert knee.patent[:, 3] == pytest.approx(np.pi - np.abs(knee.patent[:, 0]))
    assert not knee.patent_gimbal[away].any()


def test_gimbal_lock_of_the_patent_is_flagged() -> None:
    upright = np.tile(rotation.IDENTITY, (20, 1))
    turned = np.tile(rotation.exp(np.array((0.0, np.pi / 2.0, 0.0))), (20, 1))
    found = fuse_trial(mean_model(), recorded(upright, turned), KNEE)
    assert found.angles["knee"].patent_gimbal == pytest.approx(1.0)
    assert found.angles["knee"].patent[:, 2] == pytest.approx(0.0)


def test_a_stored_length_and_its_uncertainty_give_positions() -> None:
    model = mean_model((("thigh", 0.42), ("shank", 0.4)))
    upright = np.tile(rotation.IDENTITY, (20, 1))
    found = fuse_trial(model, recorded(upright, upright), chain_of(model, left=False))
    assert found.positions["ankle"].position[-1] == pytest.approx((0.0, 0.0, -0.82))
    sure = replace(model, segment={k: replace(v, length_sd=0.0) for k, v in model.segment.items()})
    same = fuse_trial(sure, recorded(upright, upright), chain_of(sure, left=False))
    added = found.positions["ankle"].sd ** 2 - same.positions["ankle"].sd ** 2
    assert added == pytest.approx(2 * 0.01**2 / 3.0)


def test_positions_are_unknown_while_a_segment_is_lost() -> None:
    upright = np.tile(rotation.IDENTITY, (200, 1))
    gone = upright.copy()
    gone[50:] = np.nan
    chain = chain_of(mean_model(), left=False, lengths={"thigh": 0.4, "shank": 0.4})
    found = fuse_trial(mean_model(), recorded(upright, gone), chain)
    assert np.isfinite(found.positions["knee"].position).all()
    assert np.isnan(found.positions["ankle"].position[-1]).all()
    assert np.isnan(found.angles["knee"].patent[-1]).all()
    assert np.isnan(found.angles["knee"].patent_gimbal[-1])


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with trials and a model of known orientations and unknown lengths."""
    folder = write_trials(tmp_path_factory.mktemp("positions"))
    (folder / "model.json").write_text(json.dumps(mean_model().to_dict()))
    return folder


def apply(files: Path, out: Path, *options: object) -> Any:
    result = run("apply", files / "model.json", files / "m1.npz", "--out", out, *options)
    assert result.exit_code == 0, result.output
    return result


def test_all_formats_contain_the_same_positions_and_patent_angles(
    files: Path, tmp_path: Path
) -> None:
    options = [*LENGTHS, "--origin", "0.1,0.2,0.9", "--up", "y"]
    for ending in ("npz", "csv", "sto", "mot"):
        apply(files, tmp_path / f"r.{ending}", *options)
    with np.load(tmp_path / "r.npz", allow_pickle=False) as arrays:
        ankle, patent = arrays["position_ankle"], np.rad2deg(arrays["patent_knee"])
        gimbal, sd = arrays["patent_gimbal_knee"], arrays["sd_position_ankle"]

    # In a CSV file, z is up.
    with (tmp_path / "r.csv").open() as text:
        table = list(csv.DictReader(text))
    written = np.array([[float(row[f"ankle_{axis}_m"]) for axis in "xyz"] for row in table])
    assert written == pytest.approx(ankle, abs=1e-8)
    assert float(table[7]["knee_patent_gamma_deg"]) == pytest.approx(patent[7, 2], abs=1e-6)
    assert {row["knee_patent_gimbal"] for row in table} == {"0"} == {f"{x:g}" for x in gimbal}

    # In these STO and MOT files, y is up, x forward, and z to the right.
    positions, both = read_sto(tmp_path / "r_positions.sto"), read_sto(tmp_path / "r.mot")
    angles = read_sto(tmp_path / "r_angles.sto")
    assert (positions.in_degrees, angles.in_degrees, both.in_degrees) == (False, True, True)
    for place in (positions, both):
        columns = [place.column(f"ankle_{axis}") for axis in "xyz"]
        assert np.stack(columns, axis=1) == pytest.approx(ankle[:, [1, 2, 0]], abs=1e-6)
        assert place.column("ankle_position_sd") == pytest.approx(sd, abs=1e-6)
    for table_of_angles in (angles, both):
        for k, name in enumerate(("alpha", "beta", "gamma", "joint")):
            column = table_of_angles.column(f"knee_patent_{name}")
            assert column == pytest.approx(patent[:, k], abs=1e-4)


def test_positions_below_an_unknown_length_are_left_out_with_the_remedy(
    files: Path, tmp_path: Path
) -> None:
    result = apply(files, tmp_path / "r.csv", "--length", "thigh=0.42")
    assert (
        "positions of ankle left out, because the length of shank is unknown: add"
        " --length shank=METRES" in result.stdout
    )
    head = (tmp_path / "r.csv").read_text().partition("\n")[0].split(",")
    assert {"hip_x_m", "knee_x_m"} < set(head)
    assert not any(name.startswith("ankle") for name in head)


def test_no_position_is_written_without_the_first_length(files: Path, tmp_path: Path) -> None:
    result = apply(files, tmp_path / "r.sto", "--length", "shank=0.4", "--json")
    found = json.loads(result.stdout)
    assert "positions of knee, ankle left out" in found["notes"][0]
    assert found["files"] == [str(tmp_path / "r.sto"), str(tmp_path / "r_angles.sto")]


def write_gap(path: Path, shank: slice, thigh: slice) -> Path:
    """Write a trial without sensor data of the shank and of the thigh in the given frames."""
    trial = movement(1)
    for name in "ABCD":
        trial.sensors[name][thigh if name in "AB" else shank] = np.nan
    write_orientations_npz(path, trial)
    return path


@pytest.mark.parametrize("ending", ["sto", "mot"])
def test_frames_with_unknown_values_are_left_out_of_opensim_files(
    files: Path, tmp_path: Path, ending: str
) -> None:
    opensim = pytest.importorskip("opensim", reason="opensim is not installed")
    opensim.Logger.setLevelString("off")
    # If all sensors of a segment are missing, the fusion repeats its last orientation for 10 frames
    # (0.2 s). The two gaps together therefore omit only 30 frames.
    gap = write_gap(tmp_path / "gap.npz", np.s_[50:80], np.s_[60:90])
    out = tmp_path / f"r.{ending}"
    result = run("apply", files / "model.json", gap, "--out", out, *LENGTHS)
    assert result.exit_code == 0, result.output
    names = [path.name for path in sorted(tmp_path.glob("r*"))]
    assert len(names) == (3 if ending == "sto" else 1)
    for name in names:
        kind = opensim.TimeSeriesTable
        kind = opensim.TimeSeriesTableQuaternion if name == "r.sto" else kind
        read = kind(str(tmp_path / name))
        assert read.getNumRows() == N - 30
        assert f"{name}: {N - 30} of {N} frames written" in result.stdout


def test_a_segment_without_sensors_is_left_out_of_opensim_files(
    files: Path, tmp_path: Path
) -> None:
    gap = write_gap(tmp_path / "gap.npz", np.s_[:], np.s_[:10])
    out = tmp_path / "r.mot"
    result = run("apply", files / "model.json", gap, "--out", out, "--json")
    assert result.exit_code == 0, result.output
    found = read_sto(out)
    assert found.columns == ("thigh_sd",)
    assert len(found.t_s) == N - 10
    assert "knee_flexion, knee_adduction" in json.loads(result.stdout)["notes"][-2]


def test_a_table_without_a_complete_frame_is_a_failure(files: Path, tmp_path: Path) -> None:
    gap = write_gap(tmp_path / "gap.npz", np.s_[:140], np.s_[50:])
    out = tmp_path / "r.sto"
    result = run("apply", files / "model.json", gap, "--out", out)
    assert result.exit_code == 1
    assert f"{out}: 0 of {N} frames written" in result.stderr
    assert not out.exists()


def test_lags_and_side_that_a_stored_calibration_does_not_determine_are_noted(
    files: Path, tmp_path: Path
) -> None:
    lags_ns = {"A": 12_000_000, "B": -3_000_000, "C": 0, "D": 500_000}
    fitted = mean_model()
    stored = replace(
        fitted,
        sensor={name: replace(s, lag_ns=lags_ns[name]) for name, s in fitted.sensor.items()},
        quality={},
    )
    store = CalibrationStore(tmp_path, "leg")
    path = store.path(store.save(stored))

    def notes(*options: object) -> str:
        out = tmp_path / "r.csv"
        result = run("apply", path, files / "m1.npz", "--out", out, "--json", *options)
        assert result.exit_code == 0, result.output
        return " ".join(json.loads(result.stdout)["notes"])

    assert "differ by 15.0 ms and are not applied (A 12.0, B -3.0, C 0.0, D 0.5 ms)" in notes()
    assert "interpolate each sensor at t + lag" in notes()
    assert "side assumed to be right" in notes()
    one_lag = notes("--left", "--without", "A", "--without", "B")
    assert "lag" not in one_lag
    assert "side" not in one_lag


def test_a_fitted_model_has_no_notes_on_lags_or_side(files: Path, tmp_path: Path) -> None:
    text = apply(files, tmp_path / "r.csv").stdout
    assert "lag" not in text
    assert "side" not in text


def test_a_calibration_stored_by_the_daemon_is_a_model_with_its_lengths(
    files: Path, tmp_path: Path
) -> None:
    store = CalibrationStore(tmp_path, "leg")
    version = store.save(mean_model((("thigh", 0.42), ("shank", 0.4))))
    out = tmp_path / "r.npz"
    stored = run("apply", store.path(version), files / "m1.npz", "--out", out)
    assert stored.exit_code == 0, stored.output
    with np.load(out, allow_pickle=False) as arrays:
        position = arrays["position_ankle"]
    apply(files, out, *LENGTHS)
    with np.load(out, allow_pickle=False) as arrays:
        assert position == pytest.approx(arrays["position_ankle"])


def test_an_edited_calibration_is_rejected(files: Path, tmp_path: Path) -> None:
    store = CalibrationStore(tmp_path, "leg")
    path = store.path(store.save(mean_model((("thigh", 0.42),))))
    path.write_text(path.read_text().replace("0.42", "0.43"))
    text = said(run("apply", path, files / "m1.npz", "--out", tmp_path / "r.csv"))
    assert "the checksum differs" in text
    assert "expected a model written by" in text


def fit(folder: Path, *options: object) -> dict[str, Any]:
    """Fit the method ``mean`` to a trial; return the segments of the model."""
    out = folder / "fitted.json"
    result = run("fit", folder / "t.npz", *LIMB, "--method", "mean", "--out", out, *options)
    assert result.exit_code == 0, result.output
    segments: dict[str, Any] = json.loads(out.read_text())["segment"]
    return segments


def write_with_origins(path: Path, trial: OrientationTrial, shank: Array) -> None:
    """Write a trial with the hip at the origin of the world and the knee at `shank`."""
    origins = {"thigh": np.zeros((N, 3)), "shank": shank}
    write_orientations_npz(path, OrientationTrial(trial.t_s, trial.sensors, trial.bones, origins))


def test_a_fit_stores_lengths_between_bone_origins_and_those_of_options(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    knee = np.zeros((N, 3))
    knee[:, 2] = -0.42 + 0.002 * rng.normal(size=N)
    knee[:5] = np.nan
    knee[5:10, 2] = -9.0  # these values are outliers
    write_with_origins(tmp_path / "t.npz", movement(), knee)
    found = fit(tmp_path, "--length", "shank=0.39")
    assert found["thigh"]["length"] == pytest.approx(0.42, abs=0.0005)
    assert found["thigh"]["length_sd"] == pytest.approx(0.002, rel=0.3)
    assert (found["shank"]["length"], found["shank"]["length_sd"]) == (0.39, 0.0)
    assert fit(tmp_path, "--length", "thigh=0.4")["thigh"]["length"] == 0.4


def test_a_static_trial_with_bone_origins_gives_the_length(tmp_path: Path) -> None:
    write_orientations_npz(tmp_path / "t.npz", movement())
    write_with_origins(tmp_path / "still.npz", still(), np.tile((0.0, 0.0, -0.44), (N, 1)))
    found = fit(tmp_path, "--static", tmp_path / "still.npz")
    assert found["thigh"]["length"] == pytest.approx(0.44)
    assert found["shank"]["length"] is None


def test_bone_origins_in_millimetres_are_rejected(tmp_path: Path) -> None:
    write_with_origins(tmp_path / "t.npz", movement(), np.tile((0.0, 0.0, -420.0), (N, 1)))
    options = [*LIMB, "--method", "mean", "--out", tmp_path / "x.json"]
    text = said(run("fit", tmp_path / "t.npz", *options))
    assert "p_thigh and p_shank are 420 m apart" in text
    assert "in metres" in text


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        (["--length", "tigh=0.4"], "did you mean 'thigh'?"),
        (["--length", "thigh"], "expected SEGMENT=METRES"),
        (["--length", "thigh=long"], "expected SEGMENT=METRES"),
        (["--length", "thigh=nan"], "expected SEGMENT=METRES"),
        (["--length", "thigh=420"], "convert the length to metres"),
        (["--length", "thigh=-0.4"], "more than 0 and less than 3 m"),
        ([*LENGTHS, "--length", "thigh=0.4"], "thigh appears more than once"),
        (["--origin", "0,0"], "expected X,Y,Z of the first joint in metres"),
        (["--origin", "0,inf,0"], "expected X,Y,Z of the first joint in metres"),
    ],
)
def test_lengths_and_origins_that_are_none_are_rejected(
    files: Path, tmp_path: Path, option: list[str], expected: str
) -> None:
    out = ["--out", tmp_path / "r.csv"]
    text = said(run("apply", files / "model.json", files / "m1.npz", *out, *option))
    assert expected in text
