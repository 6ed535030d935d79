"""Chain models: rigid segments on joints with markers, and the pose of a chain."""

from jointfit_daemon.kinematics.chains._coupled_joint import CoupledCurve
from jointfit_daemon.kinematics.chains._layout import ChainLayout, layout_of
from jointfit_daemon.kinematics.chains._model import (
    ChainModel,
    InvalidChainModelError,
    Joint,
    JointKind,
    Marker,
    Sample,
    Segment,
)
from jointfit_daemon.kinematics.chains._motion import (
    ChainState,
    apply_step,
    between_coordinates,
    exp_matrix,
    jacobian,
    marker_positions,
    place_coupled,
    rest_state,
    segment_poses,
    step_between,
    step_state,
    transforms,
    twists,
)

__all__ = [
    "ChainLayout",
    "ChainModel",
    "ChainState",
    "CoupledCurve",
    "InvalidChainModelError",
    "Joint",
    "JointKind",
    "Marker",
    "Sample",
    "Segment",
    "apply_step",
    "between_coordinates",
    "exp_matrix",
    "jacobian",
    "layout_of",
    "marker_positions",
    "place_coupled",
    "rest_state",
    "segment_poses",
    "step_between",
    "step_state",
    "transforms",
    "twists",
]
