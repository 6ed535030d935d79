"""Sphere fits and two-sided methods: centers and axes of rotation in space."""

from jointfit_daemon.center_of_rotation.spatial._geometric_solver import (
    NOISE_FACTOR,
    SphereOptions,
    evaluate_sphere,
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
from jointfit_daemon.center_of_rotation.spatial._sphere_sums import center_sums

__all__ = [
    "NOISE_FACTOR",
    "RunningSphere",
    "SphereLimits",
    "SphereOptions",
    "center_sums",
    "evaluate_sphere",
    "fit_axis",
    "fit_running",
    "fit_score",
    "fit_sphere",
    "gamage_lasenby",
    "halvorsen",
    "objection",
    "relative",
    "solve_sphere",
    "spatial_noise",
    "turn_noise",
]
