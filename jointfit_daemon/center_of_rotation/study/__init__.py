"""Monte Carlo study of the planar estimators over arc, noise and radius."""

from jointfit_daemon.center_of_rotation.study._circle_study import (
    CLIPS_M,
    PRINTED,
    PairMaps,
    StudySetup,
    correlation,
    run_study,
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
    "PRINTED",
    "PairMaps",
    "StudySetup",
    "bisector_center",
    "compare_methods",
    "correlation",
    "rotation_pole",
    "run_study",
]
