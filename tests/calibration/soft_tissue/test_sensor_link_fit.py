"""A sensor link predicts the rotation between two sensors, and its error, from the posture."""

from __future__ import annotations

from math import cos, radians, sin
from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.calibration.soft_tissue import fit_links
from jointfit_daemon.calibration.soft_tissue._sensor_link_fit import independent_frames
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import up_one
from jointfit_daemon.model import Chain

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import SensorLink
    from jointfit_daemon.model import Vector

KNEE = Chain(("hip", "knee", "ankle"), ("thigh", "shank"), (("S1", "S2"), ("S3",)))
N = 2000
ARTEFACT = 0.1
"""Rotation of S2 on the thigh per radian of thigh tilt."""


def flexed(angles: Array) -> Array:
    """Return rotations about x, shape (n, 4)."""
    return rotation.exp(np.stack([angles, 0 * angles, 0 * angles], axis=1))


def tilted(angle: float) -> Vector:
    return up_one((cos(0.5 * angle), sin(0.5 * angle), 0.0, 0.0))


def pair_of(thigh: Array, noise: Array) -> SensorLink:
    sensors = {
        "S1": flexed(thigh),
        "S2": flexed(thigh * (1.0 + ARTEFACT) + noise),
        "S3": flexed(-thigh),
    }
    static = {"thigh": rotation.IDENTITY, "shank": rotation.IDENTITY}
    return next(link for link in fit_links(KNEE, sensors, static) if link.kind == "pair")


@pytest.fixture(scope="module")
def link() -> SensorLink:
    """Return the link of S1 and S2, trained with thigh tilts of up to 20 degrees."""
    random = np.random.default_rng(1)
    thigh = radians(20.0) * np.sin(np.linspace(0.0, 60.0, N))
    return pair_of(thigh, radians(0.5) * random.standard_normal(N))


def test_link_expects_the_artefact_of_a_trained_posture(link: SensorLink) -> None:
    angle = radians(15.0)
    (x, y, z), sd = link.predict(tilted(angle), tilted(-angle))
    assert (x, y, z) == pytest.approx((ARTEFACT * angle, 0.0, 0.0), abs=radians(0.2))
    assert radians(0.2) < sd < radians(0.6)


def test_standard_deviation_of_a_link_contains_its_error_in_untrained_postures(
    link: SensorLink,
) -> None:
    _, before = link.predict(tilted(radians(15.0)), tilted(radians(-15.0)))
    for degrees in (40.0, 60.0, 90.0):
        angle = radians(degrees)
        (x, _, _), sd = link.predict(tilted(angle), tilted(-angle))
        assert sd > 1.5 * before
        assert abs(x - ARTEFACT * angle) < 3.0 * sd
        before = sd


def test_movement_in_which_residuals_are_alike_leaves_a_link_less_certain() -> None:
    """Slow noise has fewer independent frames than white noise, so the predicted sd is larger."""
    random = np.random.default_rng(2)
    thigh = radians(20.0) * np.sin(np.linspace(0.0, 60.0, N))
    white = random.standard_normal(N)
    slow = np.convolve(random.standard_normal(N + 99), np.ones(100) / 10.0, mode="valid")
    postures = tilted(radians(30.0)), tilted(radians(-30.0))
    sds = [
        pair_of(thigh, radians(0.5) * noise / np.std(noise)).predict(*postures)[1]
        for noise in (white, slow)
    ]
    assert sds[1] > 1.2 * sds[0]


def test_frames_are_independent_for_regressors_that_are_not_alike() -> None:
    """Constant residuals count as many independent frames if the regressors are white noise."""
    random = np.random.default_rng(4)
    alike = np.ones((2000, 1))
    assert independent_frames(alike, random.standard_normal((2000, 2))) > 500


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9])
def test_independent_frames_of_an_autoregressive_process_are_counted(correlation: float) -> None:
    random = np.random.default_rng(3)
    white = random.standard_normal((20_000, 3))
    process = np.zeros_like(white)
    for k in range(1, len(white)):
        process[k] = correlation * process[k - 1] + white[k]

    # The limit for many frames is n (1 - r) / (1 + r), with n frames and the correlation r of
    # successive frames.
    expected = len(white) * (1.0 - correlation) / (1.0 + correlation)
    constant = np.ones((len(white), 1))
    assert independent_frames(process, constant) == pytest.approx(expected, rel=0.15)


def test_perfect_fit_counts_as_one_independent_frame() -> None:
    assert independent_frames(np.zeros((50, 1)), np.ones((50, 1))) == pytest.approx(1.0)
