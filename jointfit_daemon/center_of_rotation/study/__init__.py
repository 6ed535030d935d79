"""Monte Carlo study of the planar estimators over arc, noise and radius."""

from jointfit_daemon.center_of_rotation.study._circle_study import (
    CLIPS_M,
    PRINTED,
    PairMaps,
    StudySetup,
    correlation,
    run_study,
)

__all__ = ["CLIPS_M", "PRINTED", "PairMaps", "StudySetup", "correlation", "run_study"]
