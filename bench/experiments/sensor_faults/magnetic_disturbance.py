"""Magnetic disturbance: the headings of one or both sensors deviate for half a minute.

An orientation filter with a magnetometer follows a changed field within seconds. The simulated
headings deviate by 20 to 40 degrees in one direction, for one sensor or for both sensors of a
segment. Disturbances occur in all movements. The fused orientations are compared with the bones,
and with the fused orientations of the same subject without disturbance.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bench.experiments.sensor_faults.loss_slip_drift import (
    JUMP_GOAL,
    RATE_HZ,
    SEEDS,
    calibrated_people,
    fuser_of,
)
from bench.framework.experiment import Experiment, Result, median_and_worst
from bench.framework.material import simulated_subjects
from bench.subjects import faulty_wearer
from bench.subjects.faulty_wearer import PULL_S, SEGMENTS, STAY_S
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from bench.subjects.faulty_wearer import SubjectRecording
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import LimbState

PEOPLE = (*SEEDS, 11, 12, 13, 14)
"""Seeds of the subjects. The limits of the detector were chosen without the last four subjects."""
MAGNET_S, FIRST_S, APART_S = 80.0, 12.3, 2.9
LEAST_DEG, MOST_DEG = 20.0, 40.0
PASSED_DEG = 10.0
"""Deviation of the heading at which the delay of a report begins, deg."""
OVER_S = 8.0
"""Time from the end of the disturbance to the first frame that is evaluated as undisturbed, s."""
ALONE = (("S1",), ("S2",), ("S3",), ("S4",))
BOTH = (("S1", "S2"), ("S3", "S4"))
FLEXION_GOAL = 1.96
"""Number of standard deviations that contains 95 % of normal errors in one dimension."""


class Pulled(NamedTuple):
    """Results of one subject and one disturbance."""

    delay_s: float
    """Time from a deviation of 10 degrees to the first warning, s; infinite without a warning."""
    ended_s: float
    """Time from the end of the disturbance to the last event of recovery, s; infinite without
    event."""
    others: int
    """Number of events about other sensors or segments. If both sensors of a segment are disturbed,
    events about either segment are accepted."""
    segment: Array
    """Error of both segments divided by the predicted RMS error, during the disturbance, shape (2
    n,)."""
    flexion: Array
    """Error of knee flexion divided by its predicted standard deviation, during the disturbance."""
    healthy: Array
    """Values of `segment` for the subject without disturbance."""
    knee: tuple[float, float, float]
    """RMS error of the knee rotation, rad: during the disturbance, after it, and of the undisturbed
    subject in both periods together."""


def _cases(
    seeds: tuple[int, ...], groups: Sequence[tuple[str, ...]]
) -> Iterator[tuple[Calibration, SubjectRecording, tuple[str, ...], float, float]]:
    for seed, calibration in calibrated_people(seeds):
        person = faulty_wearer.live(seed, MAGNET_S, RATE_HZ)
        for k, names in enumerate(groups):
            dice = np.random.default_rng(10 * seed + k)
            angle = np.deg2rad(dice.uniform(LEAST_DEG, MOST_DEG)) * dice.choice([-1.0, 1.0])
            yield calibration, person, names, FIRST_S + APART_S * k + 0.37 * seed, float(angle)


def _pulled(
    calibration: Calibration,
    person: SubjectRecording,
    names: tuple[str, ...],
    at_s: float,
    angle: float,
) -> Pulled:
    healthy, _ = faulty_wearer.play(fuser_of(calibration), person)
    states, told = faulty_wearer.play(
        fuser_of(calibration), faulty_wearer.pulled(person, names, at_s, angle)
    )
    end_s = at_s + 2 * PULL_S + STAY_S
    lasts = (person.t_s >= at_s) & (person.t_s < end_s)
    after = person.t_s >= end_s + OVER_S
    here = "thigh" if names[0] in ("S1", "S2") else "shank"
    known = {here, *names, *(SEGMENTS if len(names) > 1 else ())}
    right = [t for t, news in told if news.level == "warning" and news.id in known]
    over = [t for t, news in told if news.level == "info" and news.id in known]
    passed_s = at_s + PULL_S * _share_passed(abs(angle))
    without = faulty_wearer.joint_errors(healthy, person)[lasts | after]
    errors = faulty_wearer.joint_errors(states, person)
    return Pulled(
        delay_s=right[0] - passed_s if right else np.inf,
        ended_s=over[-1] - end_s if over else np.inf,
        others=sum(news.id not in known for _, news in told),
        segment=np.concatenate([_over_claimed(states, person, i)[lasts] for i in (0, 1)]),
        healthy=np.concatenate([_over_claimed(healthy, person, i)[lasts] for i in (0, 1)]),
        flexion=_flexion_over_claimed(states, person)[lasts],
        knee=(_rms(errors[lasts]), _rms(errors[after]), _rms(without)),
    )


def _share_passed(angle: float) -> float:
    """Return the time at which the disturbance passes 10 degrees, as a share of its rise time."""
    grid = np.linspace(0.0, 1.0, 501)
    way = grid * grid * (3.0 - 2.0 * grid) * angle
    return float(np.interp(np.deg2rad(PASSED_DEG), way, grid))


def _over_claimed(states: Sequence[LimbState], person: SubjectRecording, i: int) -> Array:
    claimed = np.sqrt(3.0) * np.array([s.segments[i].sd for s in states], dtype=np.float64)
    true = person.bones[SEGMENTS[i]]
    return np.asarray(
        rotation.angle_between(faulty_wearer.segment_orientations(states, i), true) / claimed
    )


def _flexion_over_claimed(states: Sequence[LimbState], person: SubjectRecording) -> Array:
    knees = [state.joints[1] for state in states]
    said = np.array([np.nan if k.angles is None else k.angles.flexion for k in knees])
    sd = np.array([np.nan if k.angle_sd is None else k.angle_sd for k in knees])
    return np.asarray(np.abs(said - person.flexion) / sd)


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x**2)))


def magnet(
    _: Path, groups: Sequence[tuple[str, ...]], seeds: tuple[int, ...] = PEOPLE
) -> list[Result]:
    """Measure delays of the events about a disturbance, and errors of the output."""
    found = [_pulled(*case) for case in _cases(seeds, groups)]
    delays = np.array([case.delay_s for case in found])
    segment, healthy, flexion = (
        np.concatenate([getattr(case, name) for case in found])
        for name in ("segment", "healthy", "flexion")
    )
    knees = np.rad2deg([case.knee for case in found]).T
    lasting, after, without = (_rms(errors) for errors in knees)
    return [
        Result("detected", 100.0 * float(np.mean(np.isfinite(delays))), 100.0, 100.0, unit="%"),
        Result(
            "detection delay after exceeding 10°, median", float(np.median(delays)), 2.0, unit="s"
        ),
        Result("detection delay after exceeding 10°, worst", float(delays.max()), 2.0, unit="s"),
        Result(
            "delay of the recovery report, worst",
            max(case.ended_s for case in found),
            10.0,
            unit="s",
        ),
        Result("false attributions", float(sum(case.others for case in found)), 0.0, unit=""),
        _share("segment errors within the stated 95 % bound", segment < JUMP_GOAL),
        _share("flexion errors within the stated 95 % bound", flexion < FLEXION_GOAL),
        _share(
            "segment errors within the stated 95 % bound, undisturbed", healthy < JUMP_GOAL, 0.0
        ),
        Result("knee rotation error, disturbed", lasting),
        *median_and_worst("knee rotation error, disturbed", knees[0].tolist()),
        Result("knee rotation error, after the disturbance", after, round(without + 0.5, 3)),
        *median_and_worst(
            "knee rotation error, after the disturbance",
            knees[1].tolist(),
            maximum=round(float(np.median(knees[2])) + 0.5, 3),
            worst_maximum=float("inf"),
        ),
        Result("knee rotation error, undisturbed", without),
        *median_and_worst("knee rotation error, undisturbed", knees[2].tolist()),
    ]


def _share(name: str, held: NDArray[np.bool_], least: float = 95.0) -> Result:
    return Result(name, 100.0 * float(np.mean(held)), 100.0, least, unit="%")


NOT_RECOVERED = (
    "in 1 of the 40 single-sensor cases, recovery was not reported within 10 s: the disagreement "
    "of the pair remained between the thresholds of alarm and recovery"
)
EXPERIMENTS = (
    Experiment(
        "magnetic-disturbance-one-sensor",
        "The heading of one sensor is disturbed by 20 to 40° for half a minute",
        partial(magnet, groups=ALONE),
        simulated_subjects(len(PEOPLE)),
        long=True,
        known_misses={"delay of the recovery report, worst": NOT_RECOVERED},
    ),
    Experiment(
        "magnetic-disturbance-both-sensors",
        "The headings of both sensors of a segment are disturbed by 20 to 40° for half a minute",
        partial(magnet, groups=BOTH),
        simulated_subjects(len(PEOPLE)),
        long=True,
    ),
)
