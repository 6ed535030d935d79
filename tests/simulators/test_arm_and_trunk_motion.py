"""Arm and trunk of the simulator: forward kinematics, signs, movements, rig and options."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jointfit_simulators.__main__ import main
from jointfit_simulators.body import LIMBS, SimulatedSubject, Step, UnknownMotionError
from jointfit_simulators.body._arm import (
    ELBOW,
    FOREARM_M,
    SHOULDER,
    SHOULDER_IN_THORAX,
    UPPER_ARM_M,
    WRIST,
    arm_pose,
)
from jointfit_simulators.body._limb import COORDINATES, PELVIS_POSITION, PELVIS_TURN, LegGeometry
from jointfit_simulators.body._motion import motions_of
from jointfit_simulators.body._motion_script import MotionScript
from jointfit_simulators.body._posture import draw_style
from jointfit_simulators.body._trunk import LUMBAR, THORAX_M, trunk_pose
from jointfit_simulators.scene import RigOptions
from jointfit_simulators.scene._rig_file import rig_toml
from jointfit_simulators.settings import Knobs, perfect

STYLE = draw_style(LegGeometry(), np.random.default_rng(5))
NEW = ("legs", "arm", "trunk")
EVERY_MOTION = [(limb, name) for limb in NEW for name in LIMBS[limb].motions]
angle = st.floats(-1.2, 1.2)


@given(st.lists(angle, min_size=12, max_size=12), st.lists(angle, min_size=3, max_size=3))
def test_arm_is_rigid_and_its_joints_are_the_ends_of_its_bones(
    angles: list[float], position: list[float]
) -> None:
    coordinates = np.zeros((1, COORDINATES))
    coordinates[0, PELVIS_POSITION] = position
    for columns, found in zip(
        (PELVIS_TURN, SHOULDER, ELBOW, WRIST), np.reshape(angles, (4, 3)), strict=True
    ):
        coordinates[0, columns] = found
    pose = arm_pose(coordinates)
    thorax, upper_arm, forearm = (pose.orientations[p] for p in ("thorax", "upper_arm", "forearm"))
    shoulder = np.array(position) + thorax.apply(SHOULDER_IN_THORAX)
    np.testing.assert_allclose(pose.origins["upper_arm"], shoulder, atol=1e-12)
    along = (pose.origins["forearm"] - pose.origins["upper_arm"])[0]
    np.testing.assert_allclose(upper_arm.inv().apply(along), [[0, 0, -UPPER_ARM_M]], atol=1e-12)
    along = (pose.origins["hand"] - pose.origins["forearm"])[0]
    np.testing.assert_allclose(forearm.inv().apply(along), [[0, 0, -FOREARM_M]], atol=1e-12)
    # In textbooks, the sequence is flexion, carrying angle and pronation, about rotated axes.
    elbow = (upper_arm.inv() * forearm).as_euler("XYZ")
    np.testing.assert_allclose(elbow, [angles[6:9]], atol=1e-9)


@pytest.mark.parametrize(
    ("columns", "moved", "direction"),
    [
        (SHOULDER.start, "forearm", (0, 1, 0)),  # flexion: elbow forward
        (SHOULDER.start + 1, "forearm", (-1, 0, 0)),  # adduction: elbow to the left
        (ELBOW.start, "hand", (0, 1, 0)),  # flexion: wrist forward
    ],
)
def test_angles_of_the_right_arm_have_their_clinical_signs(
    columns: int, moved: str, direction: tuple[int, int, int]
) -> None:
    coordinates = np.zeros((1, COORDINATES))
    at_rest = arm_pose(coordinates).origins[moved][0]
    coordinates[0, columns] = 0.3
    assert np.dot(arm_pose(coordinates).origins[moved][0] - at_rest, direction) > 0.05


@pytest.mark.parametrize(("column", "direction"), [(0, (0, 1, 0)), (1, (1, 0, 0))])
def test_trunk_bends_forward_and_to_the_right(column: int, direction: tuple[int, int, int]) -> None:
    coordinates = np.zeros((1, COORDINATES))
    coordinates[0, LUMBAR.start + column] = 0.3
    pose = trunk_pose(coordinates)
    assert np.dot(pose.origins["head"][0], direction) == pytest.approx(THORAX_M * np.sin(0.3))
    coordinates[:] = 0.0
    coordinates[0, LUMBAR.start + 2] = 0.3  # to the left: the anterior axis towards -x
    assert trunk_pose(coordinates).orientations["thorax"].apply([0, 1, 0])[0, 0] < -0.2


@pytest.mark.parametrize(("limb", "name"), EVERY_MOTION)
def test_every_motion_has_two_continuous_derivatives(limb: str, name: str) -> None:
    script = MotionScript(
        motions_of(STYLE, LIMBS[limb].motions),
        [Step("stand", 2.0), Step(name, 4.0), Step("functional", 9.0)],
    )
    jumps = []
    # If the second derivative is continuous, its largest change decreases with the step.
    for step in (2e-3, 1e-3):
        second = np.diff(script.coordinates(np.arange(1.0, 9.0, step)), n=2, axis=0) / step**2
        jumps.append(float(np.abs(np.diff(second, axis=0)).max()))
    assert jumps[1] < 0.65 * jumps[0]


def test_abduction_passes_90_degrees_and_the_functional_motion_moves_every_joint() -> None:
    t = np.arange(0.0, 30.0, 0.02)
    motions = motions_of(STYLE, LIMBS["arm"].motions)
    pose = arm_pose(motions["abduction"](t))
    thorax, upper_arm = pose.orientations["thorax"], pose.orientations["upper_arm"]
    long_axis = (thorax.inv() * upper_arm).apply([0.0, 0.0, -1.0])
    elevation = np.degrees(np.arccos(-long_axis[:, 2]))
    assert elevation.min() < 10.0
    assert 110.0 < elevation.max() < 135.0
    reach = np.ptp(np.degrees(motions["functional"](t)), axis=0)
    assert np.all(reach[SHOULDER] > [80, 80, 20])
    assert np.all(reach[ELBOW] > [100, 3, 40])
    assert np.all(reach[WRIST] > [40, 15, 1])
    reach = np.ptp(np.degrees(motions_of(STYLE, LIMBS["trunk"].motions)["functional"](t)), axis=0)
    assert np.all(reach[LUMBAR] > [55, 30, 30])


@pytest.mark.parametrize("limb", LIMBS)
def test_observation_agrees_with_the_bones_of_every_limb(limb: str) -> None:
    """Without errors, sensors have a constant alignment and markers are fixed in their part."""
    subject = SimulatedSubject(perfect(Knobs()), [Step("functional", 1.0)], limb=limb)
    t = np.arange(0.0, 5.0, 0.05)
    found = subject.observe([t] * len(subject.sensors), t, t)
    for (_, part), q in zip(subject.sensors.items(), found.sensors, strict=True):
        bone = found.truth.orientations[part]
        off = bone.inv() * Rotation.from_quat(q, scalar_first=True)
        assert (off[0].inv() * off).magnitude().max() < 1e-9
    names = [name for cluster in subject.clusters.values() for name in cluster]
    assert found.markers.shape[1] == len(names) == len(set(names))
    first = 0
    for part, cluster in subject.clusters.items():
        points = found.markers[:, first : first + len(cluster)]
        first += len(cluster)
        if part != "plate":
            local = found.truth.orientations[part].inv().apply(points[:, 1] - points[:, 0])
            np.testing.assert_allclose(local, np.broadcast_to(local[0], local.shape), atol=1e-9)
    main = LIMBS[limb].main
    assert found.truth.joint == main.name == subject.facts["joint"]
    # The logged angles equal the angles that SciPy computes from the bones.
    upper, lower = (found.truth.orientations[p] for p in (main.proximal, main.distal))
    sign = -1.0 if limb in {"leg", "legs", "trunk"} else 1.0
    angles = (upper.inv() * lower).as_euler("XYZ") * [sign, 1.0, 1.0]
    np.testing.assert_allclose(found.truth.angles, angles, atol=1e-9)


@pytest.mark.parametrize("limb", LIMBS)
def test_rig_of_every_limb_contains_its_chain(limb: str) -> None:
    kind = LIMBS[limb]
    text = rig_toml(
        RigOptions(), devices=[], mocap='[mocap]\ndriver = "natnet"', clusters=kind.clusters,
        bones=(), plate=True, chain=kind.chain,
    )  # fmt: skip
    table = tomllib.loads(text)
    assert tuple(table["chain"].get("joints", ())) == kind.chain.joints
    assert len(table["chain"].get("joint", ())) == len(kind.chain.connections)
    assert set(kind.sensors.values()) == set(kind.chain.segments)
    assert table["chain"].get("proximal") == kind.chain.proximal
    assert table["chain"].get("lengths_m", {}) == kind.chain.lengths_m
    parts = {part for part in kind.clusters if part != "plate"}
    assert set(table["mocap"]["markers"]) == parts


def test_motions_are_listed_by_limb(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["motions", "--limb", "arm"]) == 0
    printed = capfd.readouterr().out
    assert "abduction" in printed
    assert "squat" not in printed
    with pytest.raises(UnknownMotionError, match=r"'squat'.*stand, arm_swings"):
        SimulatedSubject(Knobs(), [Step("squat", 1.0)], limb="arm")


def test_a_recording_of_a_leg_is_refused_for_an_arm(
    tmp_path: pytest.TempPathFactory, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["play", "--directory", str(tmp_path), "--limb", "arm", "--motion", "kick=kick.toml"]
    assert main(options) == 2
    assert "--limb arm: --trial and --motion contain angles of a leg" in capsys.readouterr().err
