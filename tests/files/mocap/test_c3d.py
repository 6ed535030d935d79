"""C3D and marker trials: comparison with an independent reader, written files, and faults."""

from __future__ import annotations

import sys
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from jointfit_daemon.files.mocap import (
    MarkerTrajectories,
    UnknownMarkerError,
    read_marker_trial,
    write_trc,
)
from jointfit_daemon.files.mocap._c3d import MissingPackageError, read_c3d
from jointfit_daemon.files.text import MalformedFileError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

pytest.importorskip("c3d", reason="c3d is not installed (pip install jointfitd[c3d])")
ezc3d: Any = pytest.importorskip("ezc3d", reason="ezc3d is not installed")

NAMES = ("Tom:LASI", "Tom:RASI", "Tom:LKNE")


def write_c3d(path: Path, positions: NDArray[np.float64], **parameters: Any) -> None:
    """Write positions, shape (n, k, 3), NaN where missing, with ezc3d.

    `units` is mm by default. Other `parameters` become parameters of the group POINT.
    """
    file = ezc3d.c3d()
    points = file["parameters"]["POINT"]
    points["RATE"]["value"] = [200.0]
    points["LABELS"]["value"] = list(NAMES)
    file.add_parameter("POINT", "UNITS", [parameters.pop("units", "mm")])
    for key, value in parameters.items():
        file.add_parameter("POINT", key, [value])
    homogeneous = np.ones((4, positions.shape[1], len(positions)))
    homogeneous[:3] = positions.transpose(2, 1, 0)
    file["data"]["points"] = homogeneous
    file.write(str(path))


@pytest.fixture
def positions() -> NDArray[np.float64]:
    drawn = np.random.default_rng(1).uniform(-500.0, 500.0, (40, 3, 3))
    drawn[5:9, 1] = np.nan
    return drawn


def test_cut_off_file_is_refused_with_its_remedy(
    tmp_path: Path, positions: NDArray[np.float64]
) -> None:
    path = tmp_path / "cut.c3d"
    write_c3d(path, positions)
    path.write_bytes(path.read_bytes()[: -20 * 3 * 16])
    with pytest.raises(MalformedFileError, match=r"declares 40 frames.*copy or export it again"):
        read_c3d(path)


@pytest.mark.parametrize(
    ("name", "first", "missing"),
    [("markers_analogs_first100", 1, 0), ("markers_gaps_frames119to218", 119, 139)],
)
def test_an_independent_reader_sees_the_same_points_and_gaps(
    shared_data: Path, name: str, first: int, missing: int
) -> None:
    path = shared_data / "mocap" / "c3d_trc_pyomeca" / f"{name}.c3d"
    trial = read_c3d(path).trajectories
    judge = ezc3d.c3d(str(path))
    expected = judge["data"]["points"][:3].transpose(2, 1, 0) / 1000.0
    np.testing.assert_allclose(trial.positions, expected, rtol=1e-6, atol=1e-9)
    assert np.isnan(trial.positions).all(axis=-1).sum() == missing
    assert list(trial.names) == judge["parameters"]["POINT"]["LABELS"]["value"]
    assert (trial.frames[0], trial.frames[-1], trial.rate_hz) == (first, first + 99, 100.0)
    assert trial.t_s[0] == pytest.approx((first - 1) / 100.0)
    assert trial.warnings == ()


def test_residuals_of_the_cameras_are_read_in_metres(
    tmp_path: Path, positions: NDArray[np.float64]
) -> None:
    path = tmp_path / "a.c3d"
    write_c3d(path, np.nan_to_num(positions))
    assert read_marker_trial(path).residuals(["RASI"]) is None
    residuals = np.random.default_rng(2).integers(1, 200, (40, 3)).astype(np.float32)
    residuals[7, 2] = 0.0  # the residual of an interpolated point
    content = bytearray(path.read_bytes())
    begin = (int.from_bytes(content[16:18], "little") - 1) * 512
    cells = np.frombuffer(content, "<f4", 40 * 3 * 4, begin).reshape(40, 3, 4)
    cells[..., 3] = residuals + 256.0 * 0b101  # the high byte: two cameras saw the marker
    path.write_bytes(content)
    found = read_marker_trial(path).residuals(["RASI", "LKNE"])
    assert found is not None
    expected = np.where(residuals > 0.0, residuals / 1000.0, np.nan)[:, 1:]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_gaps_are_where_the_recording_has_them(shared_data: Path) -> None:
    path = shared_data / "mocap" / "c3d_trc_pyomeca" / "markers_gaps_frames119to218.c3d"
    trial = read_marker_trial(path)
    gap = np.flatnonzero(np.isnan(trial.points(["gauche_ext"])[:, 0, 0]))
    assert gap.tolist() == list(range(88, 94))
    assert (trial.up_axis, trial.up_said_by) == ("z", "file")


@pytest.mark.parametrize(("units", "scale"), [("mm", 1e-3), ("m", 1.0), ("cm", 1e-2)])
def test_written_osim_is_read_in_metres(
    tmp_path: Path, positions: NDArray[np.float64], units: str, scale: float
) -> None:
    write_c3d(tmp_path / "trial.c3d", positions, units=units)
    trial = read_c3d(tmp_path / "trial.c3d").trajectories
    np.testing.assert_allclose(trial.positions, positions * scale, rtol=1e-6, atol=1e-6)
    assert trial.names == NAMES


def test_z_is_up_for_any_screen_axis(tmp_path: Path, positions: NDArray[np.float64]) -> None:
    write_c3d(tmp_path / "trial.c3d", positions, X_SCREEN="+X", Y_SCREEN="+Y")
    trial = read_marker_trial(tmp_path / "trial.c3d")
    assert (trial.up_axis, trial.up_said_by) == ("y", "file")
    up = trial.trajectories.positions[..., 2]
    np.testing.assert_allclose(up, positions[..., 1] / 1000.0, rtol=1e-6, atol=1e-6)
    asked = read_marker_trial(tmp_path / "trial.c3d", up_axis="x")
    assert (asked.up_axis, asked.up_said_by) == ("x", "caller")


def test_turning_to_z_up_keeps_the_hand(tmp_path: Path) -> None:
    """The conversion to z up is a rotation, so the axes stay right-handed."""
    corner = np.array([[[2.0, 1.0, 1.0], [1.0, 2.0, 1.0], [1.0, 1.0, 2.0]]]) * 1000.0
    write_c3d(tmp_path / "trial.c3d", corner)
    for axis in ("x", "y", "z"):
        points = read_marker_trial(tmp_path / "trial.c3d", axis).trajectories.positions[0]
        assert np.linalg.det(points - 1.0) == pytest.approx(1.0, abs=1e-5)


def test_a_marker_in_the_origin_of_a_trc_is_missing(tmp_path: Path) -> None:
    points = np.ones((3, 1, 3))
    points[1] = 0.0
    frames = np.arange(1, 4)
    write_trc(tmp_path / "a.trc", MarkerTrajectories(("M",), frames / 100, frames, points, 100.0))
    found = read_marker_trial(tmp_path / "a.trc")
    assert np.isnan(found.points(["M"])[:, 0, 0]).tolist() == [False, True, False]
    assert (found.up_axis, found.up_said_by) == ("y", "convention of the format")


def test_a_subjects_prefix_may_be_left_out_and_misspellings_are_met_halfway(
    tmp_path: Path, positions: NDArray[np.float64]
) -> None:
    """Marker names need no subject prefix. A misspelled name gets suggestions."""
    write_c3d(tmp_path / "trial.c3d", positions)
    trial = read_marker_trial(tmp_path / "trial.c3d")
    assert np.array_equal(trial.points(["LKNE"]), trial.points(["Tom:LKNE"]), equal_nan=True)
    with pytest.raises(
        UnknownMarkerError, match=r"'LKNEE': did you mean 'LKNE.*'XX'; there are: Tom"
    ):
        trial.points(["LKNEE", "LASI", "XX"])


def test_a_file_other_than_c3d_is_rejected(tmp_path: Path) -> None:
    for name, data in (("a.c3d", b"hello"), ("b.c3d", bytes(2048)), ("c.c3d", b"")):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(MalformedFileError, match=name):
            read_c3d(tmp_path / name)
    with pytest.raises(MalformedFileError, match=r"\.trc or \.c3d"):
        read_marker_trial(tmp_path / "trial.csv")


def test_damaged_c3d_file_is_reported_by_name(
    tmp_path: Path, positions: NDArray[np.float64]
) -> None:
    write_c3d(tmp_path / "whole.c3d", positions)
    whole = (tmp_path / "whole.c3d").read_bytes()
    rng = np.random.default_rng(2)
    for trial in range(100):
        data = bytearray(whole[: int(rng.integers(1, len(whole)))] if trial % 2 else whole)
        for at in rng.integers(0, len(data), 5):
            data[at] = int(rng.integers(0, 256))
        (tmp_path / "broken.c3d").write_bytes(bytes(data))
        with suppress(MalformedFileError):
            read_c3d(tmp_path / "broken.c3d")


def test_a_missing_package_is_named_with_its_install_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "c3d", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'jointfitd\[c3d\]'"):
        read_c3d(tmp_path / "any.c3d")
