"""Sphere fits and two-sided methods: centers and axes of rotation in space."""

from jointfit_daemon.center_of_rotation.spatial._geometric_solver import (
    NOISE_FACTOR,
    SphereOptions,
    judge_sphere,
    solve_sphere,
)
from jointfit_daemon.center_of_rotation.spatial._observability import SphereLimits
from jointfit_daemon.center_of_rotation.spatial._parent_frame_noise import (
    relative,
    spatial_noise,
    turn_noise,
)
from jointfit_daemon.center_of_rotation.spatial._running_sphere import RunningSphere, fit_running
from jointfit_daemon.center_of_rotation.spatial._sara import fit_axis
from jointfit_daemon.center_of_rotation.spatial._score import fit_score
from jointfit_daemon.center_of_rotation.spatial._sphere_estimate import objection
from jointfit_daemon.center_of_rotation.spatial._sphere_fit import (
    fit_sphere,
    gamage_lasenby,
    halvorsen,
)
from jointfit_daemon.center_of_rotation.spatial._sphere_sums import centered

__all__ = [
    "NOISE_FACTOR",
    "RunningSphere",
    "SphereLimits",
    "SphereOptions",
    "centered",
    "fit_axis",
    "fit_running",
    "fit_score",
    "fit_sphere",
    "gamage_lasenby",
    "halvorsen",
    "judge_sphere",
    "objection",
    "relative",
    "solve_sphere",
    "spatial_noise",
    "turn_noise",
]
