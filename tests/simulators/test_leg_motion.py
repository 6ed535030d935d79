"""Ground truth of the simulated leg: bone lengths, clinical signs, and smooth motions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_simulators.body import (
    MOTIONS,
    LegGeometry,
    Step,
    UnknownMotionError,
    parse_motion_script,
)
from jointfit_simulators.body._limb import (
    ANKLE,
    COORDINATES,
    HIP,
    KNEE,
    PELVIS_POSITION,
    PELVIS_TURN,
    included_angle,
    leg_pose,
)
from jointfit_simulators.body._motion import motions_of
from jointfit_simulators.body._motion_file import motion_from_file
from jointfit_simulators.body._motion_script import MotionScript
from jointfit_simulators.body._posture import draw_style

if TYPE_CHECKING:
    from pathlib import Path

GEOMETRY = LegGeometry()
STYLE = draw_style(GEOMETRY, np.random.default_rng(5))
MOTIONS_OF_STYLE = motions_of(STYLE)
angle = st.floats(-1.2, 1.2)


def turn_about(axis: int, by: float) -> np.ndarray:
    """Return the textbook matrix of a rotation about x, y or z."""
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.eye(3)
    matrix[[i, j], [i, j]] = np.cos(by)
    matrix[i, j], matrix[j, i] = -np.sin(by), np.sin(by)
    return matrix


@given(st.lists(angle, min_size=12, max_size=12), st.lists(angle, min_size=3, max_size=3))
def test_forward_kinematics_equals_textbook_matrices(
    angles: list[float], position: list[float]
) -> None:
    coordinates = np.zeros((1, COORDINATES))
    coordinates[0, PELVIS_POSITION] = position
    for columns, found in zip(
        (PELVIS_TURN, HIP, KNEE, ANKLE), np.reshape(angles, (4, 3)), strict=True
    ):
        coordinates[0, columns] = found
    heading, tilt, lean = angles[:3]
    turn = turn_about(2, heading) @ turn_about(0, tilt) @ turn_about(1, lean)
    at = np.array(position) + turn @ GEOMETRY.hip_in_pelvis
    pose = leg_pose(GEOMETRY, coordinates)
    lengths = (GEOMETRY.thigh_m, GEOMETRY.shank_m, 0.0)
    for i, (part, sign) in enumerate((("thigh", 1), ("shank", -1), ("foot", 1))):
        flexion, adduction, rotation = angles[3 + 3 * i : 6 + 3 * i]
        turn = turn @ turn_about(0, sign * flexion) @ turn_about(1, adduction)
        turn = turn @ turn_about(2, rotation)
        np.testing.assert_allclose(pose.orientations[part].as_matrix()[0], turn, atol=1e-12)
        np.testing.assert_allclose(pose.origins[part][0], at, atol=1e-12)
        at = at - lengths[i] * turn[:, 2]


@pytest.mark.parametrize(
    ("joint", "moved", "axis", "sign"),
    [
        (HIP, "shank", 1, +1),  # hip flexion: knee forward
        (KNEE, "foot", 1, -1),  # knee flexion: heel back
    ],
)
def test_flexion_has_its_clinical_sign(joint: slice, moved: str, axis: int, sign: int) -> None:
    coordinates = np.zeros((1, COORDINATES))
    upright = leg_pose(GEOMETRY, coordinates).origins[moved][0, axis]
    coordinates[0, joint.start] = 0.3
    assert sign * (leg_pose(GEOMETRY, coordinates).origins[moved][0, axis] - upright) > 0.05


@pytest.mark.parametrize(("column", "axis", "sign"), [(1, 0, -1), (2, 0, -1)])
def test_adduction_and_internal_rotation_move_the_toes_medially(
    column: int, axis: int, sign: int
) -> None:
    coordinates = np.zeros((1, COORDINATES))
    coordinates[0, HIP.start + column] = 0.3
    pose = leg_pose(GEOMETRY, coordinates)
    toes = pose.origins["foot"] + pose.orientations["foot"].apply([0.0, 0.2, 0.0])
    upright = GEOMETRY.hip_in_pelvis[0]
    assert sign * (toes[0, axis] - upright) > 0.04


def test_included_angle_is_180_degrees_minus_flexion() -> None:
    coordinates = np.zeros((2, COORDINATES))
    coordinates[1, KNEE.start] = np.radians(70)
    pose = leg_pose(GEOMETRY, coordinates)
    inner = np.degrees(included_angle(pose.orientations["thigh"], pose.orientations["shank"]))
    assert inner == pytest.approx([180, 110])


def test_standing_is_upright_with_little_sway() -> None:
    t = np.arange(0.0, 60.0, 0.05)
    coordinates = MOTIONS_OF_STYLE["stand"](t)
    pose = leg_pose(GEOMETRY, coordinates)
    for part in ("thigh", "shank", "foot"):
        tilt = np.degrees(pose.orientations[part].magnitude())
        assert tilt.max() < 1.0
        second = np.degrees(
            (pose.orientations[part][:-20].inv() * pose.orientations[part][20:]).magnitude()
        )
        assert second.max() < 0.5
    np.testing.assert_allclose(pose.origins["foot"], [GEOMETRY.standing_ankle] * len(t), atol=1e-9)


@pytest.mark.parametrize(
    ("name", "least", "most"),
    [("walk", 55, 75), ("squat", 90, 110), ("sit_to_stand", 85, 105), ("knee_swings", 85, 110)],
)
def test_motions_have_physiological_knee_angles(name: str, least: float, most: float) -> None:
    knee = np.degrees(MOTIONS_OF_STYLE[name](np.arange(0, 60, 0.02))[:, KNEE])
    assert least < knee[:, 0].max() < most
    assert knee[:, 0].min() > -6
    assert np.abs(knee[:, 1]).max() < 6
    assert np.abs(knee[:, 2]).max() < 25


def test_functional_motion_exercises_all_axes() -> None:
    coordinates = np.degrees(MOTIONS_OF_STYLE["functional"](np.arange(0, 30, 0.02)))
    reach = np.ptp(coordinates, axis=0)
    assert np.all(reach[HIP] > [80, 30, 20])
    assert np.all(reach[KNEE] > [90, 1, 10])
    assert np.all(reach[ANKLE] > [40, 20, 15])


def test_plate_with_the_sensors_rotates_about_several_axes() -> None:
    coordinates = MOTIONS_OF_STYLE["plate"](np.arange(0, 30, 0.02))
    turns = coordinates[:, 18:21]
    assert np.linalg.cond(turns.T @ turns) < 4
    assert np.all(coordinates[:, 21] == 1)


def jerkiness(coordinates: np.ndarray, step: float) -> float:
    """Return the largest change of the second derivative between two steps."""
    second = np.diff(coordinates, n=2, axis=0) / step**2
    return float(np.abs(np.diff(second, axis=0)).max())


@pytest.mark.parametrize("name", MOTIONS)
def test_every_motion_has_two_continuous_derivatives(name: str) -> None:
    script = MotionScript(
        MOTIONS_OF_STYLE, [Step("stand", 2.0), Step(name, 4.0), Step("squat", 9.0)]
    )
    jumps = []
    # If the second derivative is continuous, its largest change decreases with the step.
    for step in (2e-3, 1e-3):
        t = np.arange(1.0, 9.0, step)
        jumps.append(jerkiness(script.coordinates(t), step))
    assert jumps[1] < 0.65 * jumps[0]


def test_jerkiness_detects_a_discontinuous_derivative() -> None:
    jumps = [jerkiness(np.abs(np.arange(-1, 1, s) + s / 3)[:, None], s) for s in (2e-3, 1e-3)]
    assert jumps[1] > 0.65 * jumps[0]


def test_switch_changes_later_coordinates_only() -> None:
    steps = parse_motion_script("stand:5,walk")
    script, same = MotionScript(MOTIONS_OF_STYLE, steps), MotionScript(MOTIONS_OF_STYLE, steps)
    script.play("squat", 3.0)
    past, future = np.arange(0, 3.0, 0.1), np.arange(4.6, 9, 0.1)
    np.testing.assert_array_equal(script.coordinates(past), same.coordinates(past))
    np.testing.assert_allclose(script.coordinates(future), MOTIONS_OF_STYLE["squat"](future - 3.0))
    assert [script.name_at(t) for t in (2.9, 3.1, 6.0)] == ["stand", "squat", "squat"]


def test_a_motion_that_begins_at_once_has_no_blend() -> None:
    script = MotionScript(MOTIONS_OF_STYLE, parse_motion_script("stand:5,walk"))
    script.play("squat", 3.0, at_once=True)
    t = np.arange(3.001, 9, 0.1)
    np.testing.assert_allclose(script.coordinates(t), MOTIONS_OF_STYLE["squat"](t - 3.0))
    script.discard_before(3.5)
    np.testing.assert_allclose(script.coordinates(t[6:]), MOTIONS_OF_STYLE["squat"](t[6:] - 3.0))


def test_discarding_past_motions_does_not_change_later_coordinates() -> None:
    steps = parse_motion_script("stand:3,walk:1,squat:3,turn")
    whole, discarding = MotionScript(MOTIONS_OF_STYLE, steps), MotionScript(MOTIONS_OF_STYLE, steps)
    for begin in np.arange(0.0, 12.0, 0.2):
        t = begin + np.arange(0, 0.2, 0.01)
        discarding.discard_before(begin)
        np.testing.assert_allclose(discarding.coordinates(t), whole.coordinates(t), atol=1e-15)


@pytest.mark.parametrize("text", ["", "walk:0", "walk:-1", ":5", "walk:x"])
def test_invalid_motion_scripts_are_rejected(text: str) -> None:
    with pytest.raises(ValueError, match=r"expected|convert"):
        parse_motion_script(text)


def test_unknown_motion_is_rejected_with_the_known_ones() -> None:
    with pytest.raises(UnknownMotionError, match=r"'hop'.*stand, walk"):
        MotionScript(MOTIONS_OF_STYLE, [Step("hop", 1.0)])


def test_motion_from_toml_interpolates_its_keys(tmp_path: Path) -> None:
    path = tmp_path / "kick.toml"
    path.write_text(
        "loop = true\n"
        "[[key]]\nt_s = 0.0\nknee = [10, 0, 0]\n"
        "[[key]]\nt_s = 0.6\nknee = [80, 0, 4]\nhip = [30, 0, 0]\n"
        "[[key]]\nt_s = 2.0\nknee = [10, 0, 0]\n",
        encoding="utf-8",
    )
    motion = motion_from_file(path, STYLE)
    found = np.degrees(motion(np.array([0.0, 0.6, 2.6])))
    np.testing.assert_allclose(found[:, KNEE], [[10, 0, 0], [80, 0, 4], [80, 0, 4]], atol=1e-9)
    assert found[1, HIP.start] == pytest.approx(30)


def test_motion_from_npz_holds_its_last_posture(tmp_path: Path) -> None:
    path = tmp_path / "kick.npz"
    t = np.linspace(5, 7, 50)
    np.savez(path, t=t, knee=np.column_stack([np.sin(t), 0 * t, 0 * t]))
    found = motion_from_file(path, STYLE)(np.array([0.5, 2.0, 50.0]))
    assert found[:, KNEE.start] == pytest.approx(np.sin([5.5, 7.0, 7.0]), abs=1e-4)


def test_motion_from_opensim_has_its_joint_angles(shared_data: Path) -> None:
    path = shared_data / "opencap_subject4/ik/squats1_manual_scaling_ik.mot"
    coordinates = motion_from_file(path, STYLE)(np.arange(0, 13.4, 0.01))
    knee = np.degrees(coordinates[:, KNEE.start])
    assert (knee.min(), knee.max()) == pytest.approx((0.9, 103.6), abs=0.2)
    pose = leg_pose(GEOMETRY, coordinates)
    assert np.ptp(pose.origins["foot"][:, 2]) < 0.08  # flat feet; the bone lengths differ slightly
    assert np.ptp(pose.origins["thigh"][:, 2]) > 0.3
