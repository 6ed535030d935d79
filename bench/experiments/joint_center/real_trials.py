"""Hip and knee centers of recorded subjects, compared with the centers of their models.

The thresholds are much larger than the measured values, so they detect only gross errors. Along the
axis of a hinge, the center is undetermined. The skin of the thigh slides over the femur in every
step. Results that depend on one of these two effects have no threshold.
"""

from __future__ import annotations

from functools import partial
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from bench.baselines.center_estimators import judged
from bench.framework.experiment import Experiment, Result
from bench.framework.material import GAIT_CENTERS, OPENCAP_CENTERS

if TYPE_CHECKING:
    from pathlib import Path

METHODS = ("auto", "sphere")
TRIALS = {
    "squats1": "squats",
    "STS1": "sit to stand",
    "DJ1": "drop jump",
    "walking1": "walking",
    "gait2354": "walking, three markers per segment",
}
KNEE_FLOOR_MM = 50.0


def compare(trial: str, data: Path) -> list[Result]:
    """Measure the distances from the model's centers, and the predicted errors."""
    figures: list[Result] = []
    for found in judged(data, trial, METHODS):
        floor = KNEE_FLOOR_MM if "knee" in found.joint.name else inf
        for method in METHODS:
            e = found.estimates[method]
            name = f"{found.joint.name}, {e.method}"
            if e.refused is not None:
                name += " (rejected)"
            figures.append(Result(f"{name}: stated error", 1000 * e.rms_error, inf, unit="mm"))
            if np.isfinite(e.center).all():
                told = 1000 * found.told_across(method)
                figures.append(
                    Result(f"{name}: stated error across the axis", told, inf, unit="mm")
                )
                off, across = 1000 * found.off(method), 1000 * found.off_axis(method)
                figures += [
                    Result(f"{name}: distance to the model", off, inf, unit="mm"),
                    Result(
                        f"{name}: distance to the model across the axis", across, floor, unit="mm"
                    ),
                ]
    return figures


IDS = {
    "squats": "model-centers-squats",
    "sit to stand": "model-centers-sit-to-stand",
    "drop jump": "model-centers-drop-jump",
    "walking": "model-centers-walking",
    "walking, three markers per segment": "model-centers-gait",
}


def _comparison(trial: str, movement: str) -> Experiment:
    folder = "opensim_gait2354" if trial == "gait2354" else "opencap_subject4"
    return Experiment(
        IDS[movement],
        f"Functional joint centres compared with the centres of the model: {movement}",
        partial(compare, trial),
        GAIT_CENTERS if trial == "gait2354" else OPENCAP_CENTERS,
        recordings=(folder,),
        packages=("opensim",),
        long=True,
        headline=movement == "squats",
    )


EXPERIMENTS = tuple(_comparison(*item) for item in TRIALS.items())
