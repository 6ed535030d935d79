"""Both legs of the simulator: mirrored bones, clinical signs, movements of one leg."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_simulators.body import LIMBS
from jointfit_simulators.body._legs import MOTIONS, legs_pose
from jointfit_simulators.body._limb import (
    COORDINATES,
    HIP,
    KNEE,
    LEFT_HIP,
    LEFT_KNEE,
    LEFT_LEG_ANGLES,
    LEG_ANGLES,
    PELVIS_TURN,
    LegGeometry,
    leg_pose,
)
from jointfit_simulators.body._motion import motions_of
from jointfit_simulators.body._posture import draw_style

STYLE = draw_style(LegGeometry(), np.random.default_rng(5))
MIRROR = np.diag([-1.0, 1.0, 1.0])
angles = st.lists(st.floats(-1.2, 1.2), min_size=9, max_size=9)


@given(angles, angles)
def test_exchanged_angles_give_the_mirror_image(right: list[float], left: list[float]) -> None:
    one, other = np.zeros((1, COORDINATES)), np.zeros((1, COORDINATES))
    one[0, LEG_ANGLES], one[0, LEFT_LEG_ANGLES] = right, left
    other[0, LEG_ANGLES], other[0, LEFT_LEG_ANGLES] = left, right
    a, b = legs_pose(one), legs_pose(other)
    for part in ("thigh", "shank", "foot"):
        mirrored = MIRROR @ b.orientations[f"left_{part}"].as_matrix()[0] @ MIRROR
        np.testing.assert_allclose(
            a.orientations[f"right_{part}"].as_matrix()[0], mirrored, atol=1e-9
        )
        origin = MIRROR @ b.origins[f"left_{part}"][0]
        np.testing.assert_allclose(a.origins[f"right_{part}"][0], origin, atol=1e-12)


@pytest.mark.parametrize(
    ("column", "moved", "direction"),
    [
        (LEFT_HIP.start, "left_shank", (0, 1, 0)),  # flexion: knee forward
        (LEFT_HIP.start + 1, "left_shank", (1, 0, 0)),  # adduction: knee to the midline
        (LEFT_KNEE.start, "left_foot", (0, -1, 0)),  # flexion: heel back
    ],
)
def test_angles_of_the_left_leg_have_their_clinical_signs(
    column: int, moved: str, direction: tuple[int, int, int]
) -> None:
    coordinates = np.zeros((1, COORDINATES))
    at_rest = legs_pose(coordinates).origins[moved][0]
    coordinates[0, column] = 0.3
    assert np.dot(legs_pose(coordinates).origins[moved][0] - at_rest, direction) > 0.05


def test_the_right_leg_walks_like_the_single_leg_and_the_left_one_half_a_stride_later() -> None:
    t = np.arange(0.0, 11.0, 0.01)
    both, single = motions_of(STYLE, MOTIONS)["walk"](t), motions_of(STYLE)["walk"](t)
    np.testing.assert_array_equal(both[:, : LEFT_HIP.start], single[:, : LEFT_HIP.start])
    pose = leg_pose(LegGeometry(), single)
    np.testing.assert_array_equal(legs_pose(both).origins["right_foot"], pose.origins["foot"])
    right, left = both[:, KNEE.start], both[:, LEFT_KNEE.start]
    delay = min(range(110), key=lambda k: float(np.std(left[k:] - right[: len(right) - k])))
    assert delay in range(51, 60)  # half a stride of 110 frames


def test_the_functional_motion_moves_every_joint_of_both_legs() -> None:
    t = np.arange(0.0, 32.0, 0.02)
    reach = np.ptp(np.degrees(motions_of(STYLE, MOTIONS)["functional"](t)), axis=0)
    for hip, knee in ((HIP, KNEE), (LEFT_HIP, LEFT_KNEE)):
        assert np.all(reach[hip] > [60, 25, 20])
        assert np.all(reach[knee] > [85, 2, 15])
    one_leg = motions_of(STYLE, MOTIONS)["left_knee_swings"](t)
    assert np.ptp(np.degrees(one_leg[:, KNEE.start])) < 10.0
    assert np.ptp(np.degrees(one_leg[:, LEFT_KNEE.start])) > 70.0


def test_sensors_and_markers_cover_both_legs() -> None:
    kind = LIMBS["legs"]
    assert len(kind.sensors) == 10
    for part, markers in kind.clusters.items():
        assert len(markers) >= 4, part
    templates = kind.templates(np.random.default_rng(1))
    for part in ("thigh", "shank"):
        assert templates[f"right_{part}"][:, 0].mean() > 0.02  # lateral side
        assert templates[f"left_{part}"][:, 0].mean() < -0.02
    assert np.all(np.isfinite(motions_of(STYLE, MOTIONS)["plate"](np.zeros(1))[:, PELVIS_TURN]))
