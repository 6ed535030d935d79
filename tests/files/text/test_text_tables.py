"""Real TRC, STO, MOT and NPZ files have the sizes in their READMEs; written files are read back."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from jointfit_daemon.files.mocap import MarkerTrajectories, read_trc, write_trc
from jointfit_daemon.files.orientations import (
    OrientationTable,
    OrientationTrial,
    TimeTable,
    read_orientations_npz,
    read_orientations_sto,
    read_sto,
    write_orientations_npz,
    write_orientations_sto,
    write_sto,
)
from jointfit_daemon.files.text import MalformedFileError

if TYPE_CHECKING:
    from pathlib import Path

numbers = st.floats(-1e4, 1e4, allow_subnormal=False) | st.just(float("nan"))
tables = st.integers(1, 6).flatmap(lambda n: arrays(np.float64, (n, 2, 3), elements=numbers))


@pytest.mark.parametrize(
    ("name", "frames", "markers", "missing"),
    [
        ("opencap_subject4/trc/static1.trc", 517, 55, 0.0),
        ("opencap_subject4/trc/walking1.trc", 131, 51, 0.019),
        ("opencap_subject4/trc/squats1.trc", 1346, 51, 0.0),
        ("opencap_subject4/trc/DJ1.trc", 269, 51, 0.0003),
        ("opencap_subject4/trc/STS1.trc", 1399, 51, 0.0),
        ("opensim_gait2354/subject01_walk1.trc", 151, 41, 0.0),
        ("opensim_gait2354/subject01_static.trc", 300, 49, 0.0),
        ("mocap/c3d_trc_pyomeca/markers.trc", 93, 51, 0.0),
    ],
)
def test_real_trc_files_hold_what_their_readmes_count(
    shared_data: Path, name: str, frames: int, markers: int, missing: float
) -> None:
    found = read_trc(shared_data / name)
    assert found.positions.shape == (frames, markers, 3)
    assert len(found.names) == len(set(found.names)) == markers
    assert np.mean(np.isnan(found.positions)) == pytest.approx(missing, abs=6e-4)
    assert np.nanmax(np.abs(found.positions)) < 5  # metres, whatever the file's unit


def test_trc_header_contradictions_are_warnings(shared_data: Path) -> None:
    found = read_trc(shared_data / "mocap/c3d_trc_pyomeca/markers.trc")
    assert found.warnings == ("header NumFrames is 652, counted 93",)
    assert found.names[0] == "ASISl"
    assert found.positions[0, 0] == pytest.approx([0.7337041, 0.0809832, 0.1918668], abs=1e-9)
    mean = found.positions.mean(axis=(0, 1))
    assert mean == pytest.approx([0.601247890, 0.315934672, 0.361031201], abs=1e-9)
    assert found.frames.tolist() == list(range(1, 94))
    assert found.t_s[-1] == 0.92


@pytest.mark.parametrize(
    ("name", "rows", "in_degrees", "figures"),
    [
        ("inverse_kin.mot", 88, True, (-27.90807185, -24.623570680)),
        ("inverse_dyn.sto", 92, False, (-4.47756531, -8.352192616)),
    ],
)
def test_real_tables_hold_what_their_readme_counts(
    shared_data: Path, name: str, rows: int, in_degrees: bool, figures: tuple[float, float]
) -> None:
    found = read_sto(shared_data / "mocap/c3d_trc_pyomeca" / name)
    assert found.values.shape == (rows, 25)
    assert found.in_degrees is in_degrees
    first_and_mean = (found.values[0, 0], found.values[:, 0].mean())
    assert first_and_mean == pytest.approx(figures, abs=1e-9)
    assert found.warnings == (f"header nrows is 250, counted {rows}",)


def test_opensim_kinematics_read_with_their_units(shared_data: Path) -> None:
    found = read_sto(shared_data / "opencap_subject4/ik/squats1_manual_scaling_ik.mot")
    knee = found.column("knee_angle_r")
    assert found.in_degrees
    assert (knee.min(), knee.max()) == pytest.approx((0.9, 103.6), abs=0.06)
    assert not read_sto(
        shared_data / "opencap_subject4/ik/squats1_addbiomechanics_ik.mot"
    ).in_degrees


@given(tables)
def test_trc_round_trip(tmp_path_factory: pytest.TempPathFactory, positions: np.ndarray) -> None:
    path = tmp_path_factory.mktemp("trc") / "a.trc"
    n = len(positions)
    wrote = MarkerTrajectories(
        ("T1", "Left knee"), np.arange(n) / 100, np.arange(1, n + 1), positions, 100.0
    )
    write_trc(path, wrote)
    found = read_trc(path)
    assert found.names == wrote.names
    assert found.warnings == ()
    np.testing.assert_allclose(found.positions, wrote.positions, rtol=6e-8, atol=0)
    np.testing.assert_array_equal(found.frames, wrote.frames)


@given(tables, st.booleans())
def test_sto_round_trip(
    tmp_path_factory: pytest.TempPathFactory, values: np.ndarray, in_degrees: bool
) -> None:
    path = tmp_path_factory.mktemp("sto") / "a.sto"
    n = len(values)
    wrote = TimeTable(tuple("abcdef"), np.arange(n) / 50, values.reshape(n, 6), in_degrees)
    write_sto(path, wrote)
    found = read_sto(path)
    assert (found.columns, found.in_degrees, found.warnings) == (wrote.columns, in_degrees, ())
    np.testing.assert_allclose(found.values, wrote.values, rtol=6e-8, atol=0)


def test_orientation_tables_are_read_back_with_their_gaps(tmp_path: Path) -> None:
    quaternions = Rotation.random(6, rng=3).as_quat().reshape(3, 2, 4)
    quaternions[1, 0] = np.nan
    path = tmp_path / "imu.sto"
    write_orientations_sto(path, OrientationTable(("a", "b"), np.arange(3.0), quaternions, 100.0))
    found = read_orientations_sto(path)
    assert (found.names, found.rate_hz) == (("a", "b"), 100.0)
    np.testing.assert_allclose(found.quaternions, quaternions, rtol=6e-8)


@pytest.mark.parametrize("separator", ["\t", ",", "  "])
def test_any_separator_is_accepted(tmp_path: Path, separator: str) -> None:
    rows = ["name", "inDegrees=YES", "EndHeader", separator.join(["time", "x", "y"])]
    rows += [separator.join(["0.0", "1", "nan"]), separator.join(["0.1", "2", "3"]), ""]
    path = tmp_path / "a.mot"
    path.write_text("\n".join(rows), encoding="utf-8")
    found = read_sto(path)
    assert found.columns == ("x", "y")
    np.testing.assert_array_equal(found.values, [[1, np.nan], [2, 3]])


@pytest.mark.parametrize("text", ["", "hello\n", "a\nendheader\n", "a\nendheader\nx\ty\n1\t2\n"])
def test_a_file_of_another_kind_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.sto"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(MalformedFileError, match=r"a\.sto"):
        read_sto(path)
    with pytest.raises(MalformedFileError, match=r"a\.sto"):
        read_trc(path)


@pytest.mark.parametrize(
    ("name", "frames_rate_missing", "flexion"),
    [
        ("squats1", (673, 50, 0), (7.3, 104.5)),
        ("walking1", (131, 100, 3), (8.9, 66.3)),
        ("DJ1", (269, 100, 0), (2.7, 113.4)),
    ],
)
def test_real_orientation_trials_hold_what_their_readme_counts(
    shared_data: Path,
    name: str,
    frames_rate_missing: tuple[int, int, int],
    flexion: tuple[float, float],
) -> None:
    found = read_orientations_npz(shared_data / "semireal_knee4imu" / f"{name}.npz")
    frames, rate, missing = frames_rate_missing
    assert sorted(found.sensors) == ["S1", "S2", "S3", "S4"]
    assert sorted(found.bones) == ["femur_r", "tibia_r"]
    assert len(found.t_s) == frames
    assert 1 / np.median(np.diff(found.t_s)) == pytest.approx(rate, rel=1e-3)
    assert sum(np.isnan(q[:, 0]).sum() for q in found.sensors.values()) == missing
    femur, tibia = (
        Rotation.from_quat(found.bones[bone], scalar_first=True) for bone in ("femur_r", "tibia_r")
    )
    knee = np.degrees(-(femur.inv() * tibia).as_euler("XYZ")[:, 0])
    assert (knee.min(), knee.max()) == pytest.approx(flexion, abs=0.06)
    down = found.origins["tibia_r"] - found.origins["femur_r"]  # from hip to knee
    along = -femur.as_matrix()[:, :, 2]  # z points from the knee to the hip
    lean = np.sum(down * along, axis=1) / np.linalg.norm(down, axis=1)
    assert lean.min() > 0.99


def test_npz_round_trip(tmp_path: Path) -> None:
    quaternions = Rotation.random(5, rng=1).as_quat(scalar_first=True)
    wrote = OrientationTrial(
        np.arange(5.0), {"S1": quaternions}, {"thigh": quaternions}, {"thigh": np.ones((5, 3))}
    )
    path = tmp_path / "a.npz"
    write_orientations_npz(path, wrote)
    found = read_orientations_npz(path)
    np.testing.assert_allclose(found.sensors["S1"], quaternions)
    np.testing.assert_allclose(found.bones["thigh"], quaternions)
    np.testing.assert_array_equal(found.origins["thigh"], wrote.origins["thigh"])
