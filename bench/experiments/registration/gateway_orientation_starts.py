"""Orientation filter on the gateway after a start or a gap, for ten starts per recorded trial."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.framework.experiment import Experiment, Result
from bench.framework.material import BOARD
from bench.subjects import raw_imu_trials
from jointfit_daemon.kinematics import rotation
from jointfit_drivers.gateway_orientation import LONGEST_SETTLE_S

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array

STARTS = 10
SECOND = round(1e9 / raw_imu_trials.PERIOD_NS)
LENGTH = 23 * SECOND
"""Number of samples of one run, 23 s."""
GAP = slice(11 * SECOND, 13 * SECOND)
"""Indices of the samples that are lost in the gap."""
FIRST_MAX_DEG, LATER_MAX_DEG, GAP_MAX_DEG = 6.0, 4.0, 4.0


def ten_starts(data: Path) -> list[Result]:
    """Measure the largest RMS error among ten starts per trial, in three periods of one second.

    The periods are the first second with output, the second around 10 s after the start, and the
    first second with output after a gap of 2 s. The settling time is the time from the start, or
    from the end of the gap, to the first output.
    """
    figures = []
    for path in sorted((data / "broad").glob("*.hdf5")):
        trial = raw_imu_trials.load(data, path.stem)
        seen = np.flatnonzero(np.isfinite(trial.optical[:, 0]))
        starts = np.linspace(seen[0], seen[-1] - LENGTH, STARTS).astype(int)
        errors = np.array([errors_of_start(trial, int(start)) for start in starts])
        worst = np.nanmax(errors[:, :3], axis=0)
        worst_s = float(np.max(errors[:, 3:]))
        limits = (
            ("first second", FIRST_MAX_DEG),
            ("at 10 s", LATER_MAX_DEG),
            ("after a gap of 2 s", GAP_MAX_DEG),
        )
        figures += [
            Result(
                f"trial {path.stem[:2]}: {label}",
                float(value),
                limit,
                note=f"median {np.nanmedian(column):.1f}°",
            )
            for (label, limit), value, column in zip(limits, worst, errors[:, :3].T, strict=True)
        ]
        note = f"median {np.median(errors[:, 3:]):.1f} s"
        name = f"trial {path.stem[:2]}: time to settle"
        figures.append(Result(name, worst_s, LONGEST_SETTLE_S, unit="s", note=note))
    return figures


def errors_of_start(trial: raw_imu_trials.BoardTrial, start: int) -> tuple[float, ...]:
    """Return the RMS errors of the three periods, deg, and the two settling times, s."""
    part = slice(start, start + LENGTH)
    felt = [values[part] for values in trial.felt]
    optical = trial.optical[part]
    whole = raw_imu_trials.output_by_sample(felt, range(LENGTH), settle_s=LONGEST_SETTLE_S)
    kept = [*range(GAP.start), *range(GAP.stop, LENGTH)]
    broken = raw_imu_trials.output_by_sample(felt, kept, settle_s=LONGEST_SETTLE_S)
    middle = 10 * SECOND
    settled, again = _first(whole, 0), _first(broken, GAP.stop)
    return (
        _rms_deg(whole, optical, settled),
        _rms_deg(whole, optical, middle - SECOND // 2),
        _rms_deg(broken, optical, again),
        settled / SECOND,
        (again - GAP.stop) / SECOND,
    )


def _first(q: Array, after: int) -> int:
    """Return the index of the first sample with output from index `after` on."""
    return after + int(np.flatnonzero(np.isfinite(q[after:, 0]))[0])


def _rms_deg(q: Array, optical: Array, begin: int) -> float:
    """Return the RMS error of the second that begins at a given sample, deg."""
    part = slice(begin, begin + SECOND)
    error = rotation.angle_between(q[part], optical[part])
    return float(np.rad2deg(np.sqrt(np.nanmean(error**2))))


EXPERIMENTS = (
    Experiment(
        "gateway-orientation-ten-starts",
        "Orientation filter after a start and after a gap, ten times per trial",
        ten_starts,
        BOARD,
        recordings=("broad",),
        packages=("vqf", "h5py"),
        long=True,
    ),
)
