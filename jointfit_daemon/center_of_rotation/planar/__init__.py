"""Circle fits: centers of rotation in a plane."""

from jointfit_daemon.center_of_rotation.planar._circle_estimate import CircleLimits, circle_estimate
from jointfit_daemon.center_of_rotation.planar._circle_fit import (
    CircleMethod,
    Circles,
    fit_circle,
    fit_circles,
)
from jointfit_daemon.center_of_rotation.planar._geometric_fit import geometric_estimate
from jointfit_daemon.center_of_rotation.planar._grid_search import Grid, grid_center
from jointfit_daemon.center_of_rotation.planar._moments import GATE, ellipse_scale
from jointfit_daemon.center_of_rotation.planar._oriented_fit import AngleNoise, oriented_estimate
from jointfit_daemon.center_of_rotation.planar._parent_frame_noise import planar_noise
from jointfit_daemon.center_of_rotation.planar._plane import plane_of
from jointfit_daemon.center_of_rotation.planar._running_circle import RunningCircle
from jointfit_daemon.center_of_rotation.planar._three_frame_errors import (
    three_frame_error,
    three_frame_mean_squares,
)
from jointfit_daemon.center_of_rotation.planar._three_frames import (
    equal_step_error,
    three_frame_center,
    three_frame_estimate,
)

__all__ = [
    "GATE",
    "AngleNoise",
    "CircleLimits",
    "CircleMethod",
    "Circles",
    "Grid",
    "RunningCircle",
    "circle_estimate",
    "ellipse_scale",
    "equal_step_error",
    "fit_circle",
    "fit_circles",
    "geometric_estimate",
    "grid_center",
    "oriented_estimate",
    "planar_noise",
    "plane_of",
    "three_frame_center",
    "three_frame_error",
    "three_frame_estimate",
    "three_frame_mean_squares",
]
