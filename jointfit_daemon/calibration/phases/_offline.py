"""Fits and judgements on whole trials with a reference, as files hold them; no clocks, no markers.

Law: pure. Sensors and reference are in one world and on one time axis already. What is judged was
never fitted to: a whole trial is left out, or, of a single one, its last part. The calibration that
comes out is the one the daemon uses, with lengths and joint centers unknown.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration._errors import CalibrationRefused
from jointfit_daemon.calibration.registration import RobustMean, static_bias
from jointfit_daemon.calibration.soft_tissue import (
    FEWEST_FRAMES,
    METHODS,
    LimbTraining,
    all_alive,
    error_correlations,
    fit_links,
    fit_models,
)
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.joint_angles import functional_axis, joint_rotation, swing_twist
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion
from jointfit_daemon.limb_model import (
    Calibration,
    JointCalibration,
    SegmentCalibration,
    SensorCalibration,
    flexion_sign,
    neighbor,
    visible,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import Method
    from jointfit_daemon.model import Chain


COMPARED: tuple[Method, ...] = tuple(method for method in METHODS if method != "single")
"""Beside each sensor alone, of which ``single`` would be one again."""
MAX_TRAINING_FRAMES = 2000
"""Of one trial; of a longer one every n-th frame is taken."""


@dataclass(frozen=True, slots=True)
class OfflineTrial:
    """One movement."""

    name: str
    t_s: Array
    """Shape (n,), s."""
    sensors: Mapping[str, Array]
    """q_world_sensor by id, shape (n, 4); NaN where missing."""
    reference: Mapping[str, Array]
    """q_world_segment by segment, the same world, shape (n, 4); NaN where unseen."""

    def part(self, chosen: slice) -> OfflineTrial:
        """Return a contiguous part, or every n-th frame."""
        return OfflineTrial(
            self.name,
            self.t_s[chosen],
            {name: q[chosen] for name, q in self.sensors.items()},
            {name: q[chosen] for name, q in self.reference.items()},
        )


@dataclass(frozen=True, slots=True)
class Judged:
    """One method on one trial that it was not fitted to."""

    trial: str
    method: str
    """A method of `METHODS`, or ``single S1+S3``: the first sensor of each segment alone."""
    frames: int
    """That judged: all sensors and the reference were there."""
    segments: Mapping[str, float]
    """RMS angle to the reference, rad."""
    joints: Mapping[str, float]
    """RMS error of flexion about the functional axis of the training movement, rad."""
    flexion: Mapping[str, Array]
    """That flexion over time, rad, shape (n,)."""


@dataclass(frozen=True, slots=True)
class Judgement:
    """All methods on all trials left out."""

    rows: tuple[Judged, ...]
    reference: Mapping[str, Mapping[str, Array]]
    """Flexion by the reference, rad: by trial, then joint."""
    t_s: Mapping[str, Array]
    """Instants of all that was judged, by trial, s."""
    held_out: str
    """What was left out, in words."""


def mounts_of(chain: Chain, trials: Sequence[OfflineTrial]) -> dict[str, RobustMean]:
    """Return ``q_sensor_segment`` of every sensor as the reference of whole trials says it.

    On a still trial this is the static calibration. On movements it is the mean over what skin
    and muscle do, and learns from the reference: good for research, not for another day.
    """
    found = {}
    for i, segment in enumerate(chain.segments):
        reference = np.concatenate([trial.reference[segment] for trial in trials])
        for sensor in chain.sensors[i]:
            found[sensor] = static_bias(
                np.concatenate([trial.sensors[sensor] for trial in trials]), reference
            )
    return found


def fit_offline(
    chain: Chain,
    trials: Sequence[OfflineTrial],
    mounts: Mapping[str, Array],
    method: Method,
    *,
    notes: tuple[str, ...] = (),
    software: str = "",
    created_utc: str = "",
) -> Calibration:
    """Fit every model that live fusion may need to all trials.

    Parameters
    ----------
    mounts : mapping
        ``q_sensor_segment`` per sensor, shape (4,).

    Raises
    ------
    CalibrationRefused
        Fewer than 30 complete frames of a segment.
    """
    training = _training(chain, trials, mounts)
    _refuse_few(chain, training, "what is fitted to")
    models = fit_models(chain, training, method)
    return Calibration(
        method=method,
        joints=chain.joints,
        segments=chain.segments,
        chain_sensors=chain.sensors,
        sensor={
            name: SensorCalibration(
                as_quaternion(rotation.IDENTITY.tolist()), as_quaternion(mounts[name].tolist())
            )
            for group in chain.sensors
            for name in group
        },
        segment={
            segment: SegmentCalibration(
                as_quaternion(rotation.IDENTITY.tolist()), None, None, models[segment]
            )
            for segment in chain.segments
        },
        joint={name: JointCalibration(None, None, "unknown") for name in chain.joints},
        notes=notes,
        quality={"offline": {"trials": [trial.name for trial in trials]}},
        software=software,
        created_utc=created_utc,
        links=fit_links(chain, training.sensors, dict.fromkeys(chain.segments, rotation.IDENTITY)),
        correlations=error_correlations(chain, training, method),
    )


def evaluate(
    chain: Chain,
    trials: Sequence[OfflineTrial],
    mounts: Mapping[str, Array] | None = None,
    *,
    methods: Sequence[Method] = COMPARED,
    holdout: float = 0.4,
) -> Judgement:
    """Judge every method where it was not fitted: leave one trial out, or the end of the only one.

    Parameters
    ----------
    mounts : mapping, optional
        ``q_sensor_segment`` per sensor; None: from the reference of the training part.
    holdout : float
        Share of a single trial that judges.

    Raises
    ------
    CalibrationRefused
        Fewer than 30 complete frames of a segment, of those that are fitted to or that judge.
    """
    if len(trials) == 1:
        cut = round(len(trials[0].t_s) * (1.0 - holdout))
        folds = [([trials[0].part(slice(None, cut))], trials[0].part(slice(cut, None)))]
        said = f"the last {100 * holdout:.0f} % of the trial, fitted to the rest"
    else:
        folds = [([t for t in trials if t is not left], left) for left in trials]
        said = "one trial after the other, fitted to the others"
    rows: list[Judged] = []
    reference, t_s = {}, {}
    for training, test in folds:
        judge = _Judge.of(chain, training, test, mounts)
        rows += judge.singles()
        rows += [judge.method(method) for method in reversed(methods)]
        reference[test.name], t_s[test.name] = judge.truth, test.t_s
    return Judgement(tuple(rows), reference, t_s, said)


def _training(
    chain: Chain, trials: Sequence[OfflineTrial], mounts: Mapping[str, Array]
) -> LimbTraining:
    """Return bone-aligned frames of several trials, one after the other."""
    thin = [t.part(slice(None, None, -(-len(t.t_s) // MAX_TRAINING_FRAMES))) for t in trials]
    return LimbTraining(
        {
            name: np.concatenate([rotation.multiply(t.sensors[name], mount) for t in thin])
            for name, mount in mounts.items()
        },
        {s: np.concatenate([t.reference[s] for t in thin]) for s in chain.segments},
        np.repeat(np.arange(len(thin)), [len(t.t_s) for t in thin]),
    )


def _refuse_few(chain: Chain, frames: LimbTraining, what: str) -> None:
    """Refuse what no fit or judgement can be made of, segment by segment."""
    for i, segment in enumerate(chain.segments):
        needed = [frames.sensors[s] for s in (*chain.sensors[i], *neighbor(chain, i))]
        known = [visible(q) for q in (*needed, frames.reference[segment])]
        count = int(np.count_nonzero(np.all(known, axis=0)))
        if count < FEWEST_FRAMES:
            seen = int(np.count_nonzero(known[-1]))
            raise CalibrationRefused(
                f"{segment}: {count} complete frames in {what}, at least {FEWEST_FRAMES} are "
                f"needed (its reference alone is there in {seen}): take a trial whose sensors and "
                "reference are there together, or another --holdout"
            )


@dataclass(frozen=True, slots=True)
class _Judge:
    """What was fitted to, what judges, and the flexion axes of the former."""

    chain: Chain
    training: LimbTraining
    test: OfflineTrial
    aligned: LimbTraining
    """The test, bone-aligned."""
    axes: Mapping[str, Array]
    """Flexion of each inner joint is positive about it: `functional_axis`, and a knee's turned."""
    truth: Mapping[str, Array]

    @staticmethod
    def of(
        chain: Chain,
        training: Sequence[OfflineTrial],
        test: OfflineTrial,
        mounts: Mapping[str, Array] | None,
    ) -> _Judge:
        if mounts is None:
            mounts = {name: mean.q for name, mean in mounts_of(chain, training).items()}
        known = _training(chain, training, mounts)
        _refuse_few(chain, known, f"what is fitted to, to judge {test.name},")
        axes, truth = {}, {}
        for joint, above, below in _inner(chain):
            q = joint_rotation(known.reference[above], known.reference[below])
            axis = functional_axis(q[np.isfinite(q).all(axis=1)])
            axes[joint] = flexion_sign(joint) * axis
            truth[joint] = _flexion(test.reference[above], test.reference[below], axes[joint])
        sensors = {name: rotation.multiply(test.sensors[name], m) for name, m in mounts.items()}
        aligned = LimbTraining(sensors, test.reference)
        _refuse_few(chain, aligned, f"the part of {test.name} that judges")
        return _Judge(chain, known, test, aligned, axes, truth)

    def method(self, method: Method) -> Judged:
        """Judge one method with all sensors alive, as the daemon would use it."""
        return self._judged(
            method,
            {
                segment: all_alive(self.chain, i, method, self.training, self.aligned)
                for i, segment in enumerate(self.chain.segments)
            },
        )

    @property
    def frames(self) -> int:
        known = [
            visible(q) for q in (*self.aligned.sensors.values(), *self.test.reference.values())
        ]
        return int(np.count_nonzero(np.all(known, axis=0)))

    def singles(self) -> list[Judged]:
        """Judge the first sensor of each segment alone, then the second; who has no more, again."""
        chain = self.chain
        found = []
        for k in range(max(map(len, chain.sensors))):
            names = [group[min(k, len(group) - 1)] for group in chain.sensors]
            said = dict(zip(chain.segments, (self.aligned.sensors[n] for n in names), strict=True))
            found.append(self._judged(f"single {'+'.join(names)}", said))
        return found

    def _judged(self, method: str, said: Mapping[str, Array]) -> Judged:
        chain, reference = self.chain, self.test.reference
        flexion = {
            joint: _flexion(said[above], said[below], self.axes[joint])
            for joint, above, below in _inner(chain)
        }
        off = {j: flexion[j] - self.truth[j] for j in flexion}
        return Judged(
            self.test.name,
            method,
            self.frames,
            {s: _rms(rotation.angle_between(said[s], reference[s])) for s in chain.segments},
            {j: _rms(np.arctan2(np.sin(angle), np.cos(angle))) for j, angle in off.items()},
            flexion,
        )


def _inner(chain: Chain) -> Iterable[tuple[str, str, str]]:
    return zip(chain.joints[1:-1], chain.segments, chain.segments[1:], strict=False)


def _flexion(above: Array, below: Array, axis: Array) -> Array:
    angle: Array = swing_twist(joint_rotation(above, below), axis)[1]
    return angle


def _rms(values: Array) -> float:
    good = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(good**2))) if good.size else float("nan")
