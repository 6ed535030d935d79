"""`jointfit center` finds the known center of simulated trials, and refuses unsuitable input."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import orjson
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from jointfit_daemon.files.mocap import MarkerTrajectories, write_trc
from jointfit_daemon.tools.__main__ import app

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

run = CliRunner().invoke
NAMES = ("P1", "P2", "P3", "P4", "C1", "C2", "C3", "C4")
PARENT = np.array([[0.0, 0.0, 0.1], [0.0, 0.12, 0.1], [0.05, 0.0, 0.25], [-0.06, 0.05, 0.3]])
CHILD = np.array([[0.05, 0.0, -0.2], [-0.05, 0.03, -0.25], [0.02, 0.06, -0.3], [0.0, -0.06, -0.2]])
CENTER = np.array([0.01, 0.02, -0.15])
"""Center in the coordinate system of the positions PARENT, m. The markers CHILD surround it."""
OPTIONS = ["--parent", "P1,P2,P3,P4", "--markers", "C1,C2,C3,C4"]


def ball_trial(noise: float = 0.0005, frames: int = 400, span: float = 1.0) -> MarkerTrajectories:
    """Return a trial of a ball joint that turns in all directions; the parent moves; y is up."""
    rng = np.random.default_rng(4)
    t = np.arange(frames) / 100.0
    parent = Rotation.from_rotvec(0.3 * np.stack((np.sin(t), np.cos(0.7 * t), 0.2 * t), axis=1))
    at = np.stack((0.2 * t, np.sin(t), 1.0 + 0.0 * t), axis=1)
    swing = span * np.stack((np.sin(2 * t), 0.8 * np.cos(3.1 * t), np.sin(1.3 * t)), axis=1)
    child = parent * Rotation.from_rotvec(swing)
    seen = np.empty((frames, 8, 3))
    for k in range(4):
        seen[:, k] = parent.apply(PARENT[k]) + at
        seen[:, 4 + k] = parent.apply(CENTER) + at + child.apply(CHILD[k])
    seen += rng.normal(0.0, noise, seen.shape)
    return MarkerTrajectories(NAMES, t, np.arange(1, frames + 1), seen, 100.0)


def hinge_trial() -> MarkerTrajectories:
    """Return a trial of a joint that turns about x only, with the parent at rest; y is up."""
    rng = np.random.default_rng(4)
    t = np.arange(400) / 100.0
    turn = Rotation.from_rotvec(np.outer(0.8 * np.sin(2 * t), (1.0, 0.0, 0.0)))
    seen = np.empty((400, 8, 3))
    for k in range(4):
        seen[:, k] = PARENT[k]
        seen[:, 4 + k] = CENTER + turn.apply(CHILD[k])
    seen += np.array([0.0, 1.0, 0.0]) + rng.normal(0.0, 0.0005, seen.shape)
    return MarkerTrajectories(NAMES, t, np.arange(1, 401), seen, 100.0)


def expected_in_parent() -> NDArray[np.float64]:
    """Return CENTER in the axes that the command defines by the parent markers, m."""
    x = PARENT[1] - PARENT[0]
    normal = np.cross(x, PARENT[2] - PARENT[0])
    ex, ez = x / np.linalg.norm(x), normal / np.linalg.norm(normal)
    axes = np.stack((ex, np.cross(ez, ex), ez))
    return np.asarray(axes @ (CENTER - PARENT.mean(axis=0)))


@pytest.fixture
def trc(tmp_path: Path) -> Path:
    write_trc(tmp_path / "ball.trc", ball_trial())
    return tmp_path / "ball.trc"


def answer(*arguments: object) -> dict[str, Any]:
    result = run(app, ["center", *map(str, arguments), "--json"])
    assert result.exit_code == 0, result.stderr
    found: dict[str, Any] = orjson.loads(result.stdout)["answers"][0]
    return found


@pytest.mark.parametrize("method", ["auto", "halvorsen", "score", "running_sphere"])
def test_a_ball_joints_center_is_found_in_the_parents_own_axes(trc: Path, method: str) -> None:
    found = answer(trc, *OPTIONS, "--method", method)
    np.testing.assert_allclose(found["center_parent_m"], expected_in_parent(), atol=0.002)
    assert found["error_m"] < 0.002
    assert found["refused"] is None


def test_the_place_in_the_world_is_in_the_files_axes_at_the_mean_pose(tmp_path: Path) -> None:
    """The center in the world has the axes of the file, and belongs to the mean parent pose."""
    still = ball_trial(noise=0.0)
    parent = still.positions[:, :4]
    moved = still.positions.copy()
    # Remove the parent's motion, so the mean pose equals every pose.
    for i in range(len(moved)):
        a = parent[i] - parent[i].mean(axis=0)
        b = parent[0] - parent[0].mean(axis=0)
        turn = Rotation.align_vectors(b, a)[0]
        moved[i] = turn.apply(moved[i] - parent[i].mean(axis=0)) + parent[0].mean(axis=0)
    trial = MarkerTrajectories(NAMES, still.t_s, still.frames, moved, 100.0)
    write_trc(tmp_path / "still.trc", trial)
    first = Rotation.from_rotvec(0.3 * np.array([0.0, 1.0, 0.0]))
    expected = first.apply(CENTER) + np.array([0.0, 0.0, 1.0])
    found = answer(tmp_path / "still.trc", *OPTIONS)
    np.testing.assert_allclose(found["center_world_m"], expected, atol=1e-4)


def test_gaps_in_every_marker_change_little(tmp_path: Path) -> None:
    trial = ball_trial()
    for k in range(8):
        trial.positions[20 * k : 20 * k + 25, k] = np.nan
    write_trc(tmp_path / "gaps.trc", trial)
    found = answer(tmp_path / "gaps.trc", *OPTIONS)
    np.testing.assert_allclose(found["center_parent_m"], expected_in_parent(), atol=0.003)


def test_c3d_and_trc_of_one_trial_give_the_same_center(tmp_path: Path, trc: Path) -> None:
    pytest.importorskip("c3d", reason="c3d is not installed")
    ezc3d: Any = pytest.importorskip("ezc3d", reason="ezc3d is not installed")
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    file["parameters"]["POINT"]["LABELS"]["value"] = list(NAMES)
    file.add_parameter("POINT", "UNITS", ["mm"])
    points = np.ones((4, 8, 400))
    points[:3] = 1000.0 * ball_trial().positions.transpose(2, 1, 0)
    file["data"]["points"] = points
    file.write(str(tmp_path / "ball.c3d"))
    one, other = answer(trc, *OPTIONS), answer(tmp_path / "ball.c3d", *OPTIONS)
    np.testing.assert_allclose(one["center_parent_m"], other["center_parent_m"], atol=1e-5)
    np.testing.assert_allclose(one["center_world_m"], other["center_world_m"], atol=1e-5)


def test_two_parent_markers_and_one_of_the_child_are_enough_in_a_plane(tmp_path: Path) -> None:
    t = np.arange(300) / 100.0
    turn = Rotation.from_rotvec(np.outer(0.4 * np.sin(t), [0.0, 0.0, 1.0]))
    bend = Rotation.from_rotvec(np.outer(0.6 * np.sin(3.0 * t), [0.0, 0.0, 1.0]))
    at = np.stack((0.3 * t, 0.1 * t, 1.0 + 0.0 * t), axis=1)
    seen = np.stack(
        (
            turn.apply([0.0, 0.3, 0.0]) + at,
            turn.apply([0.0, 0.1, 0.0]) + at,
            (turn * bend).apply([0.02, -0.2, 0.01]) + at,
        ),
        axis=1,
    )
    seen += np.random.default_rng(5).normal(0.0, 0.0005, seen.shape)
    trial = MarkerTrajectories(("A", "B", "C"), t, np.arange(1, 301), seen, 100.0)
    write_trc(tmp_path / "plane.trc", trial)
    asked = ["--parent", "A,B", "--markers", "C", "--plane", "z"]
    for method in ("auto", "hyper"):
        found = answer(tmp_path / "plane.trc", *asked, "--method", method)
        # The x axis from A to B points down, and the center is 0.2 m below their middle.
        np.testing.assert_allclose(found["center_parent_m"], [0.2, 0.0], atol=0.002)
        np.testing.assert_allclose(found["center_world_m"][2], 1.0, atol=0.001)
    refused = run(app, ["center", str(tmp_path / "plane.trc"), *asked[:4]])
    assert refused.exit_code == 2
    assert "--plane" in refused.stderr


def test_each_time_window_is_a_line_of_output(trc: Path) -> None:
    result = run(app, ["center", str(trc), *OPTIONS, "--window", "1"])
    assert result.exit_code == 0
    assert [line.split()[0] for line in result.stdout.splitlines()[-4:]] == [
        "0.00–0.99",
        "1.00–1.99",
        "2.00–2.99",
        "3.00–3.99",
    ]


def test_small_motion_is_refused_with_exit_code_1(tmp_path: Path) -> None:
    write_trc(tmp_path / "still.trc", ball_trial(span=0.0))
    result = run(app, ["center", str(tmp_path / "still.trc"), *OPTIONS])
    assert result.exit_code == 1
    assert "REFUSED   child marker motion" in result.stdout
    assert "move the joint" in result.stdout
    assert "nan" not in result.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--parent", "P1,P2,PP3", "--markers", "C1"], ["'PP3'", "P3"]),
        (["--parent", "P1,P2", "--markers", "C1"], ["expected at least 3", "--plane"]),
        (["--parent", "P1,P2,C1", "--markers", "C1"], ["C1", "remove them from one option"]),
        ([*OPTIONS, "--method", "spheer"], ["did you mean 'sphere'", "score"]),
        ([*OPTIONS, "--method", "oriented"], ["inertial", 'center_method = "oriented"']),
        (["--parent", "P1,P2,P3", "--markers", "C1,C2", "--method", "score"], ["three"]),
        ([*OPTIONS, "--up", "w"], ["--up", "x, y or z"]),
    ],
)
def test_invalid_options_are_rejected_with_a_remedy(
    trc: Path, arguments: list[str], words: list[str]
) -> None:
    result = run(app, ["center", str(trc), *arguments])
    assert result.exit_code == 2
    for word in words:
        assert word in result.stderr


def test_collinear_or_incomplete_parent_markers_are_rejected(tmp_path: Path) -> None:
    trial = ball_trial()
    trial.positions[:, 2] = 0.3 * trial.positions[:, 0] + 0.7 * trial.positions[:, 1]
    write_trc(tmp_path / "line.trc", trial)
    asked = ["--parent", "P1,P2,P3", "--markers", "C1,C2"]
    result = run(app, ["center", str(tmp_path / "line.trc"), *asked])
    assert (result.exit_code, "collinear" in result.stderr) == (2, True)
    trial.positions[::2, 0], trial.positions[1::2, 1] = np.nan, np.nan
    write_trc(tmp_path / "part.trc", trial)
    result = run(app, ["center", str(tmp_path / "part.trc"), *asked])
    assert (result.exit_code, "omit the marker" in result.stderr) == (2, True)


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_implausible_marker_distances_are_rejected(tmp_path: Path, factor: float) -> None:
    trial = ball_trial()
    write_trc(tmp_path / "unit.trc", replace(trial, positions=factor * trial.positions))
    result = run(app, ["center", str(tmp_path / "unit.trc"), *OPTIONS])
    assert result.exit_code == 2
    assert "check the unit stated in the file" in result.stderr


def test_all_markers_are_listed_once_however_many_names_are_wrong(trc: Path) -> None:
    asked = ["--parent", "thigh,shank,foot", "--markers", "C1"]
    result = run(app, ["center", str(trc), *asked])
    assert result.exit_code == 2
    assert result.stderr.count("there are: P1, P2") == 1
    assert result.stderr.count("no marker") == 3


def test_hinge_reports_the_error_normal_to_its_axis(tmp_path: Path) -> None:
    write_trc(tmp_path / "hinge.trc", hinge_trial())
    asked = [str(tmp_path / "hinge.trc"), *OPTIONS]
    found = answer(*asked)
    assert found["error_m"] is None
    assert 0.0 < found["error_seen_m"] < 0.003
    told = run(app, ["center", *asked]).stdout
    assert "error     unknown along the unobservable directions; " in told
    assert "in the other directions" in told


def test_a_missing_file_is_named() -> None:
    result = run(app, ["center", "nowhere.trc", *OPTIONS])
    assert result.exit_code == 2
    assert "nowhere.trc" in result.stderr


@pytest.mark.parametrize("kind", ["ball", "hinge"])
def test_a_plot_is_drawn(tmp_path: Path, kind: str) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    trc = tmp_path / "any.trc"
    write_trc(trc, ball_trial() if kind == "ball" else hinge_trial())
    done = subprocess.run(  # in a new process, because matplotlib keeps its fonts open
        [
            sys.executable,
            "-m",
            "jointfit_daemon.tools",
            "center",
            str(trc),
            *OPTIONS,
            "--plot",
            str(tmp_path / "a.png"),
        ],
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
