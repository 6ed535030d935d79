"""Lag estimates of the align phase, on simulated plates that are turned by hand.

Eight plates have four sensors each and are turned for 22 s. The errors of orientation filters and
cameras have the default size of the simulator. All streams have the same clock, so the true lag is
0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.framework.experiment import Experiment, Result, median_and_worst
from bench.framework.material import simulated_subjects
from bench.subjects.simulated_wearer import bench_rig, phases
from jointfit_daemon.calibration.phases import fit_plate_alignment
from jointfit_daemon.units import NS_PER_MS

if TYPE_CHECKING:
    from pathlib import Path

SEEDS = tuple(range(1, 9))
PLATES = simulated_subjects(len(SEEDS))._replace(reference="equal clocks, so the true lag is 0")
FREE = float("inf")


def on_the_plate(_: Path) -> list[Result]:
    """Measure the lag errors of all sensors, in ms and in predicted standard deviations."""
    settings = bench_rig().calibration
    lags, sigmas, refused = [], [], 0
    for seed in SEEDS:
        for found in fit_plate_alignment(phases(seed).align, settings).quality.values():
            if found.lag_ns is None or not found.lag_sigma_ns:
                refused += 1
                continue
            lags.append(found.lag_ns / NS_PER_MS)
            sigmas.append(found.lag_sigma_ns / NS_PER_MS)
        phases.cache_clear()
    off, sigma = np.abs(lags), np.array(sigmas)
    return [
        Result("sensors", float(len(off)), FREE, unit=""),
        Result("sensors without a lag estimate", float(refused), 0.0, unit=""),
        Result("error, RMS", float(np.sqrt(np.mean(off**2))), 0.5, unit="ms"),
        *median_and_worst("error", off.tolist(), "ms", maximum=0.5, worst_maximum=1.0),
        *median_and_worst("stated standard deviation", sigma.tolist(), "ms"),
        *median_and_worst(
            "error over its stated standard deviation", (off / sigma).tolist(), "sd", maximum=4.0
        ),
    ]


EXPERIMENTS = (
    Experiment(
        "lag-plate",
        "Error of the lag from the align phase, eight simulated plates with four sensors each",
        on_the_plate,
        PLATES,
        long=True,
    ),
)
