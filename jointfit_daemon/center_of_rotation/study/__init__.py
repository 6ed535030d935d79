"""Monte Carlo study of the planar estimators over arc, noise and radius."""

from jointfit_daemon.center_of_rotation.study._circle_study import (
    CLIPS_M,
    PRINTED,
    PairMaps,
    StudySetup,
    correlation,
    run_study,
)
from jointfit_daemon.center_of_rotation.study._claims import (
    LARGE_NOISE_M,
    RADII_M,
    STEPS_RAD,
    StudyExtension,
    average_repetitions,
    effect_of_radius,
    extend_study,
)
from jointfit_daemon.center_of_rotation.study._comparison import (
    APART_RAD,
    bisector_center,
    compare_methods,
    rotation_pole,
)

__all__ = [
    "APART_RAD",
    "CLIPS_M",
    "LARGE_NOISE_M",
    "PRINTED",
    "RADII_M",
    "STEPS_RAD",
    "PairMaps",
    "StudyExtension",
    "StudySetup",
    "average_repetitions",
    "bisector_center",
    "compare_methods",
    "correlation",
    "effect_of_radius",
    "extend_study",
    "rotation_pole",
    "run_study",
]
