"""`jointfit center --segment` finds all joints of simulated chains in every frame of a trial."""

from __future__ import annotations

import csv
import subprocess
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import orjson
import pytest
from typer.testing import CliRunner

from jointfit_daemon.files.mocap import MarkerTrajectories, read_trc, write_trc
from jointfit_daemon.tools.__main__ import app
from jointfit_simulators.body import SimulatedSubject, Step
from jointfit_simulators.settings import Knobs
from tests.tools.center.test_center_command import ball_trial

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array

run = CliRunner().invoke
JOINTS = ("hip", "knee", "ankle")
MARKERS = {
    "P": (0, (0.05, 0.12)),
    "T1": (1, (0.06, -0.08)),
    "T2": (1, (-0.03, -0.3)),
    "C1": (2, (0.05, -0.1)),
    "C2": (2, (-0.02, -0.28)),
    "F": (3, (0.15, -0.04)),
}
"""Index of the segment of each marker, and position of the marker relative to the proximal joint of
the segment (for the pelvis: relative to the hip), m."""
CHAIN = [
    *("--segment", "P", "--segment", "T1,T2", "--segment", "C1,C2", "--segment", "F"),
    *("--joints", "hip,knee,ankle", "--plane", "z"),
]
RATE_HZ, FRAMES = 50.0, 600


def planar_chain(
    *, noise: float = 0.0005, moving: bool = True, seed: int = 1
) -> tuple[MarkerTrajectories, Array]:
    """Return a trial of a planar chain, y up, and its true joints, m, shape (frames, 3, 2)."""
    t = np.arange(FRAMES) / RATE_HZ
    scale = 1.0 if moving else 0.02
    bends = np.stack(
        (
            0.2 * np.sin(1.1 * t),
            0.3 + 0.7 * np.sin(1.9 * t),
            -0.9 - 0.8 * np.sin(2.7 * t),
            0.5 * np.sin(3.9 * t),
        )
    )
    turn = np.exp(1j * np.cumsum(scale * bends, axis=0))
    hip = 0.3 * t + 1j * (1.0 + 0.05 * np.sin(2 * t))
    knee = hip - 0.42j * turn[1]
    joints = np.stack((hip, knee, knee - 0.4j * turn[2]), axis=1)

    origins = np.concatenate((joints[:, :1], joints), axis=1)
    points = np.stack(
        [origins[:, s] + turn[s] * complex(*place) for s, place in MARKERS.values()], axis=1
    )
    seen = np.stack((points.real, points.imag, np.full(points.shape, 0.1)), axis=-1)
    seen += np.random.default_rng(seed).normal(0.0, noise, seen.shape)
    trial = MarkerTrajectories(tuple(MARKERS), t, np.arange(1, FRAMES + 1), seen, RATE_HZ)
    return trial, np.stack((joints.real, joints.imag), axis=-1)


def reconstruct(folder: Path, trial: MarkerTrajectories, *options: str, code: int = 0) -> Any:
    """Run the command on a trial; return its JSON object."""
    write_trc(folder / "chain.trc", trial)
    result = run(app, ["center", str(folder / "chain.trc"), *options, "--json"])
    assert result.exit_code == code, result.stderr
    return orjson.loads(result.stdout)


def positions(found: Any, key: str = "position_m") -> Array:
    """Return positions or errors of all joints; NaN replaces null."""
    return np.stack([np.array(joint[key], np.float64) for joint in found["joints"]], axis=1)


def test_one_marker_at_the_ends_and_two_between_give_all_joints_in_every_frame(
    tmp_path: Path,
) -> None:
    trial, truth = planar_chain()
    found = reconstruct(tmp_path, trial, *CHAIN)
    off = positions(found)[..., :2] - truth
    rms = np.sqrt((off**2).sum(axis=2).mean(axis=0))
    assert rms.max() < 0.0015
    told = np.sqrt((positions(found, "error_m") ** 2).mean(axis=0))
    assert (rms / told).max() < 1.4
    assert [len(joint["sides"]) for joint in found["joints"]] == [1, 2, 1]


def test_gaps_are_only_where_no_segment_of_the_joint_is_visible(tmp_path: Path) -> None:
    trial, truth = planar_chain()
    trial.positions[100:350, list(MARKERS).index("T1")] = np.nan
    trial.positions[200:550, list(MARKERS).index("F")] = np.nan
    found = reconstruct(tmp_path, trial, *CHAIN)
    known = np.asarray(np.isfinite(positions(found)).all(axis=2))
    hidden = np.zeros(FRAMES, dtype=bool)
    hidden[100:350] = True
    assert (known[:, 0] == ~hidden).all()  # the thigh alone determines the hip
    assert known[:, 1:].all()  # the shank determines the knee and the ankle
    assert found["joints"][0]["longest_gap_s"] == pytest.approx(5.0)
    off = positions(found)[..., :2] - truth
    assert np.nanmax(np.sqrt((off**2).sum(axis=2))) < 0.006


def test_both_formats_hold_the_positions_in_the_axes_of_the_file(tmp_path: Path) -> None:
    trial, truth = planar_chain()
    trial.positions[10:20, 1] = np.nan
    write_trc(tmp_path / "chain.trc", trial)
    for name in ("joints.trc", "joints.csv"):
        asked = [*CHAIN, "--trajectory", str(tmp_path / name)]
        result = run(app, ["center", str(tmp_path / "chain.trc"), *asked])
        assert result.exit_code == 0, result.stderr
        assert f"wrote {tmp_path / name}" in result.stderr

    written = read_trc(tmp_path / "joints.trc")
    assert written.names == JOINTS
    assert np.isnan(written.positions[10:20, 0]).all()
    np.testing.assert_allclose(written.positions[30:, :, :2], truth[30:], atol=0.006)
    with (tmp_path / "joints.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert rows[15]["hip_x_m"] == rows[15]["hip_error_m"] == ""
    x = [float(row["knee_x_m"]) for row in rows]
    np.testing.assert_allclose(x, written.positions[:, 1, 0], atol=1e-6)
    assert 0.0 < float(rows[0]["knee_error_m"]) < 0.002


def test_centers_of_a_wide_movement_serve_a_trial_without_movement(tmp_path: Path) -> None:
    still, truth = planar_chain(moving=False, seed=2)
    refused = reconstruct(tmp_path, still, *CHAIN, code=1)
    assert np.isnan(positions(refused).astype(float)).all()
    write_trc(tmp_path / "wide.trc", planar_chain()[0])
    asked = [*CHAIN, "--centers-from", str(tmp_path / "wide.trc")]
    found = reconstruct(tmp_path, still, *asked)
    off = positions(found)[..., :2] - truth
    assert np.sqrt((off**2).sum(axis=2).mean(axis=0)).max() < 0.002


def test_a_joint_without_movement_is_refused_and_the_others_are_written(tmp_path: Path) -> None:
    trial, truth = planar_chain()
    stiff = list(MARKERS).index("F")
    along = trial.positions[:, 4, :2] - trial.positions[:, 3, :2]
    trial.positions[:, stiff, :2] = trial.positions[:, 4, :2] + 0.8 * along
    write_trc(tmp_path / "chain.trc", trial)
    out = tmp_path / "joints.trc"
    result = run(app, ["center", str(tmp_path / "chain.trc"), *CHAIN, "--trajectory", str(out)])
    assert result.exit_code == 1
    assert "REFUSED: " in result.stdout
    assert "move the joint through at least 30°" in result.stdout
    written = read_trc(out).positions
    assert np.isnan(written[:, 2]).all()
    np.testing.assert_allclose(written[:, :2, :2], truth[:, :2], atol=0.006)


def test_all_joints_of_a_simulated_leg_are_found_in_space(tmp_path: Path) -> None:
    knobs = replace(
        Knobs(seed=5), marker_soft_tissue_mm=0.0, optical_heading_deg=0.0, heading_spread_deg=0.0
    )
    subject = SimulatedSubject(knobs, [Step("functional", 1.0)])
    t = np.arange(1000) / RATE_HZ
    seen = subject.observe([t] * len(subject.sensors), t, t)
    parts = ("pelvis", "thigh", "shank", "foot")
    names = tuple(name for part in parts for name in subject.clusters[part])
    markers = seen.markers[:, : len(names)]
    markers = markers + np.random.default_rng(1).normal(0.0, 0.0005, markers.shape)
    trial = MarkerTrajectories(names, t, np.arange(1, 1001), markers, RATE_HZ)

    asked = [option for part in parts for option in ("--segment", ",".join(subject.clusters[part]))]
    found = reconstruct(tmp_path, trial, *asked, "--joints", "hip,knee,ankle", "--up", "z")
    truth = np.stack([seen.truth.joints[joint] for joint in JOINTS], axis=1)
    rms = np.sqrt(((positions(found) - truth) ** 2).sum(axis=2).mean(axis=0))
    assert rms[0] < 0.002
    assert rms[2] < 0.003
    # The position of the knee along its axis is not observable. The distance between hip and knee
    # may therefore be wrong, but it is constant.
    length = np.linalg.norm(positions(found)[:, 1] - positions(found)[:, 0], axis=1)
    assert length.std() < 0.002


def test_one_joint_needs_no_segments(tmp_path: Path) -> None:
    options = ["--parent", "P1,P2,P3,P4", "--markers", "C1,C2,C3,C4"]
    found = reconstruct(tmp_path, ball_trial(), *options, "--trajectory", str(tmp_path / "j.csv"))
    assert [joint["name"] for joint in found["joints"]] == ["joint1"]
    assert found["joints"][0]["sides_apart_m"] < 0.002
    assert (tmp_path / "j.csv").read_text().startswith("t_s,joint1_x_m,")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--segment", "T1,T2"], ["1 segment", "at least 2"]),
        (["--segment", "P", "--segment", "F"], ["P and F", "neither segment", "2 markers"]),
        (["--segment", "P", "--segment", "T1", "--segment", "C1,C2"], ["joint1", "add markers"]),
        (["--segment", "P,T1", "--segment", "T1,T2"], ["T1", "more than once"]),
        (["--segment", "P", "--segment", "T1,TT2"], ["'TT2'", "T2"]),
        ([*CHAIN[:8], "--joints", "hip,knee"], ["2 names", "expected 3"]),
        ([*CHAIN[:8], "--joints", "hip,hip,knee"], ["hip", "once"]),
        ([*CHAIN[:8], "--window", "2"], ["--window", "one joint"]),
        ([*CHAIN[:8], "--parent", "P"], ["omit --parent"]),
        (["--trajectory", "j.csv"], ["--segment"]),
        (["--parent", "T1,T2", "--markers", "P", "--joints", "hip"], ["--joints", "--segment"]),
        (["--parent", "T1,T2"], ["--markers"]),
        ([*CHAIN[:8], "--trajectory", "j.mot"], [".trc or .csv"]),
    ],
)
def test_invalid_chains_are_rejected_with_a_remedy(
    tmp_path: Path, arguments: list[str], words: list[str]
) -> None:
    write_trc(tmp_path / "chain.trc", planar_chain()[0])
    result = run(app, ["center", str(tmp_path / "chain.trc"), *arguments, "--plane", "z"])
    assert result.exit_code == 2, result.stdout
    for word in words:
        assert word in result.stderr


def test_in_space_a_frame_needs_three_markers(tmp_path: Path) -> None:
    write_trc(tmp_path / "chain.trc", planar_chain()[0])
    result = run(app, ["center", str(tmp_path / "chain.trc"), *CHAIN[:-2]])
    assert result.exit_code == 2
    assert "3 markers that define a frame (2 for a planar movement, with --plane)" in result.stderr


def test_exchanged_names_are_reported_with_their_time(tmp_path: Path) -> None:
    trial, _ = planar_chain()
    trial.positions[200:300, [1, 2]] = trial.positions[200:300, [2, 1]]
    write_trc(tmp_path / "chain.trc", trial)
    result = run(app, ["center", str(tmp_path / "chain.trc"), *CHAIN])
    assert result.exit_code == 2
    assert "T1 and T2 exchange places at 4.00 s" in result.stderr


def test_a_marker_of_another_segment_is_refused(tmp_path: Path) -> None:
    trial, _ = planar_chain()
    options = ["--segment", "T1,T2", "--segment", "F", "--plane", "z"]
    found = reconstruct(tmp_path, trial, *options, code=1)
    assert "markers of the neighbouring segment" in found["joints"][0]["sides"][0]["refused"]


def test_a_parent_marker_that_jumps_is_left_out_in_those_frames(tmp_path: Path) -> None:
    trial, truth = planar_chain()
    trial.positions[200:240, 1] += 0.2
    found = reconstruct(tmp_path, trial, *CHAIN)
    hip = positions(found)[:, 0, :2]
    assert np.isnan(hip[200:240]).all()
    assert np.nanmax(np.abs(hip - truth[:, 0])) < 0.006


def test_stick_figures_are_drawn_in_a_plane_and_in_space(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    write_trc(tmp_path / "plane.trc", planar_chain()[0])
    write_trc(tmp_path / "space.trc", ball_trial())
    ball = ["--segment", "P1,P2,P3,P4", "--segment", "C1,C2,C3,C4"]
    calls = [
        ["center", "plane.trc", *CHAIN, "--plot", "plane.png"],
        ["center", "space.trc", *ball, "--plot", "space.png"],
    ]
    script = "from jointfit_daemon.tools.__main__ import app\n" + "".join(
        f"app({call!r}, standalone_mode=False)\n" for call in calls
    )
    done = subprocess.run(  # in a new process, because matplotlib keeps its fonts open
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr
    for name in ("plane.png", "space.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
