"""Fit and evaluation of recorded trials that contain a reference orientation of each segment.

Sensors and reference have the same world and the same time axis, so clocks and markers are not
needed. The evaluation always uses held-out data, either a whole trial or the last part of a single
trial. The resulting calibration has the same form as a calibration by the daemon. Its joint centers
are unknown, and its lengths are those that the caller supplies.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration._errors import CalibrationError
from jointfit_daemon.calibration._robust_weights import rms
from jointfit_daemon.calibration.registration import RobustMean, static_mount
from jointfit_daemon.calibration.soft_tissue import (
    FEWEST_FRAMES,
    METHODS,
    LimbTraining,
    fit_all_sensors,
    fit_links,
    fit_models,
    joint_error_correlations,
    predict_all_sensors,
)
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.joint_angles import functional_axis, joint_rotation, swing_twist
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion
from jointfit_daemon.limb_model import (
    Calibration,
    JointCalibration,
    SegmentCalibration,
    SensorCalibration,
    chain_fields,
    flexion_sign,
    inner_joints,
    neighbor,
    visible,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import Method
    from jointfit_daemon.model import Chain


COMPARED: tuple[Method, ...] = tuple(method for method in METHODS if method != "single")
"""Methods that are evaluated. ``single`` is omitted, because `evaluate` also evaluates each sensor
alone.
"""
MAX_TRAINING_FRAMES = 2000
"""Largest number of training frames of one trial; longer trials are decimated."""


@dataclass(frozen=True, slots=True)
class OfflineTrial:
    """One recorded movement."""

    name: str
    t_s: Array
    """Time stamps, s, shape (n,)."""
    sensors: Mapping[str, Array]
    """q_world_sensor of each sensor, shape (n, 4); NaN if missing."""
    reference: Mapping[str, Array]
    """q_world_segment of each segment in the same world, shape (n, 4); NaN if not visible."""

    def part(self, chosen: slice) -> OfflineTrial:
        """Return a contiguous part, or every n-th frame."""
        return OfflineTrial(
            self.name,
            self.t_s[chosen],
            {name: q[chosen] for name, q in self.sensors.items()},
            {name: q[chosen] for name, q in self.reference.items()},
        )


@dataclass(frozen=True, slots=True)
class MethodScore:
    """Errors of one method on one held-out trial."""

    trial: str
    method: str
    """Method of `METHODS`, or a text such as ``single S1+S3`` for one sensor of each segment."""
    frames: int
    """Number of complete frames."""
    segments: Mapping[str, float]
    """RMS angle between estimate and reference, rad, by segment."""
    joints: Mapping[str, float]
    """RMS error of flexion about the functional axis of the training movement, rad, by joint."""
    flexion: Mapping[str, Array]
    """Estimated flexion over time, rad, shape (n,), by joint."""


@dataclass(frozen=True, slots=True)
class MethodEvaluation:
    """Errors of all methods on all held-out trials."""

    rows: tuple[MethodScore, ...]
    reference: Mapping[str, Mapping[str, Array]]
    """Flexion of the reference, rad, by trial and joint."""
    t_s: Mapping[str, Array]
    """Instants of the evaluated frames by trial, s."""
    held_out: str
    """Description of the held-out data."""


def mounts_of(chain: Chain, trials: Sequence[OfflineTrial]) -> dict[str, RobustMean]:
    """Return ``q_sensor_segment`` of every sensor from the reference of whole trials.

    For a static trial the result is the static calibration. For a movement the result contains the
    mean soft-tissue artefact of this movement, so it is not valid for another session.
    """
    found = {}
    for i, segment in enumerate(chain.segments):
        reference = np.concatenate([trial.reference[segment] for trial in trials])
        for sensor in chain.sensors[i]:
            found[sensor] = static_mount(
                np.concatenate([trial.sensors[sensor] for trial in trials]), reference
            )
    return found


def fit_offline(
    chain: Chain,
    trials: Sequence[OfflineTrial],
    mounts: Mapping[str, Array],
    method: Method,
    *,
    lengths: Mapping[str, tuple[float, float]] | None = None,
    notes: tuple[str, ...] = (),
    software: str = "",
    created_utc: str = "",
) -> Calibration:
    """Fit the models of every set of sensors to all trials.

    Parameters
    ----------
    mounts : mapping
        ``q_sensor_segment`` of each sensor, shape (4,).
    method : str
        Fusion method of the models.
    lengths : mapping, optional
        Length of each segment and its standard deviation, m; missing lengths remain unknown.
    notes, software, created_utc
        Values that are copied to the calibration.

    Raises
    ------
    CalibrationError
        A segment has fewer than 30 complete frames.
    """
    known_lengths: Mapping[str, tuple[float | None, float | None]] = lengths or {}
    training = _training(chain, trials, mounts)
    _refuse_few(chain, training, "the training data")
    models = fit_models(chain, training, method)

    # Sensors and reference have the same world, so worlds and static poses are the identity.
    identity = as_quaternion(rotation.IDENTITY.tolist())
    return Calibration(
        method=method,
        **chain_fields(chain),
        sensor={
            name: SensorCalibration(identity, as_quaternion(mounts[name].tolist()))
            for group in chain.sensors
            for name in group
        },
        segment={
            segment: SegmentCalibration(
                identity, *known_lengths.get(segment, (None, None)), models[segment]
            )
            for segment in chain.segments
        },
        joint={name: JointCalibration(None, None, "unknown") for name in chain.joints},
        notes=notes,
        quality={"offline": {"trials": [trial.name for trial in trials]}},
        software=software,
        created_utc=created_utc,
        links=fit_links(chain, training.sensors, dict.fromkeys(chain.segments, rotation.IDENTITY)),
        correlations=joint_error_correlations(chain, training, method),
    )


def evaluate(
    chain: Chain,
    trials: Sequence[OfflineTrial],
    mounts: Mapping[str, Array] | None = None,
    *,
    methods: Sequence[Method] = COMPARED,
    holdout: float = 0.4,
) -> MethodEvaluation:
    """Evaluate every method on each trial in turn, after a fit to the other trials.

    A single trial is divided: the methods are fitted to its first part and evaluated on the rest.

    Parameters
    ----------
    mounts : mapping, optional
        ``q_sensor_segment`` of each sensor. By default it is computed from the reference of the
        training part.
    holdout : float
        Held-out fraction of a single trial.

    Raises
    ------
    CalibrationError
        A segment has fewer than 30 complete frames in the training or held-out data.
    """
    if len(trials) == 1:
        cut = round(len(trials[0].t_s) * (1.0 - holdout))
        folds = [([trials[0].part(slice(None, cut))], trials[0].part(slice(cut, None)))]
        held_out = f"the last {100 * holdout:.0f} % of the trial, after a fit to the rest"
    else:
        folds = [([t for t in trials if t is not left], left) for left in trials]
        held_out = "each trial in turn, after a fit to the others"

    rows: list[MethodScore] = []
    reference, t_s = {}, {}
    for training, test in folds:
        fold = _Fold.of(chain, training, test, mounts)
        rows += fold.singles()
        rows += [fold.method(method) for method in reversed(methods)]
        reference[test.name], t_s[test.name] = fold.truth, test.t_s
    return MethodEvaluation(tuple(rows), reference, t_s, held_out)


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


def _refuse_few(chain: Chain, frames: LimbTraining, data: str) -> None:
    """Raise an error if a segment has too few complete frames."""
    for i, segment in enumerate(chain.segments):
        needed = [frames.sensors[s] for s in (*chain.sensors[i], *neighbor(chain, i))]
        known = [visible(q) for q in (*needed, frames.reference[segment])]
        count = int(np.count_nonzero(np.all(known, axis=0)))
        if count < FEWEST_FRAMES:
            seen = int(np.count_nonzero(known[-1]))
            raise CalibrationError(
                f"{segment}: {count} complete frames in {data}, at least {FEWEST_FRAMES} are "
                f"needed (its reference alone has {seen}); use a trial with simultaneous data of "
                "sensors and reference, or another --holdout"
            )


@dataclass(frozen=True, slots=True)
class _Fold:
    """Training data, held-out data and flexion axes of one fold."""

    chain: Chain
    training: LimbTraining
    test: OfflineTrial
    aligned: LimbTraining
    """The held-out trial, bone-aligned."""
    axes: Mapping[str, Array]
    """Axis of positive flexion of each inner joint, which `functional_axis` computes from the
    training movement.
    """
    truth: Mapping[str, Array]

    @staticmethod
    def of(
        chain: Chain,
        training: Sequence[OfflineTrial],
        test: OfflineTrial,
        mounts: Mapping[str, Array] | None,
    ) -> _Fold:
        if mounts is None:
            mounts = {name: mean.q for name, mean in mounts_of(chain, training).items()}
        known = _training(chain, training, mounts)
        _refuse_few(chain, known, f"the training data for {test.name}")

        axes, truth = {}, {}
        for joint, above, below in _inner(chain):
            q = joint_rotation(known.reference[above], known.reference[below])
            axis = functional_axis(q[np.isfinite(q).all(axis=1)])
            axes[joint] = flexion_sign(joint) * axis
            truth[joint] = _flexion(test.reference[above], test.reference[below], axes[joint])

        sensors = {name: rotation.multiply(test.sensors[name], m) for name, m in mounts.items()}
        aligned = LimbTraining(sensors, test.reference)
        _refuse_few(chain, aligned, f"the held-out part of {test.name}")
        return _Fold(chain, known, test, aligned, axes, truth)

    def method(self, method: Method) -> MethodScore:
        """Evaluate one method as in the daemon, with all sensors available."""
        estimates = {}
        for i, segment in enumerate(self.chain.segments):
            model = fit_all_sensors(self.chain, i, method, self.training)
            estimates[segment] = predict_all_sensors(self.chain, i, model, self.aligned)
        return self._score(method, estimates)

    def singles(self) -> list[MethodScore]:
        """Evaluate the first sensor of each segment alone, then the second, and so on."""
        chain = self.chain
        found = []
        for k in range(max(map(len, chain.sensors))):
            names = [group[min(k, len(group) - 1)] for group in chain.sensors]
            sensors = [self.aligned.sensors[name] for name in names]
            estimates = dict(zip(chain.segments, sensors, strict=True))
            found.append(self._score(f"single {'+'.join(names)}", estimates))
        return found

    def _score(self, method: str, estimates: Mapping[str, Array]) -> MethodScore:
        chain, reference = self.chain, self.test.reference
        flexion = {
            joint: _flexion(estimates[above], estimates[below], self.axes[joint])
            for joint, above, below in _inner(chain)
        }
        off = {j: flexion[j] - self.truth[j] for j in flexion}

        known = [visible(q) for q in (*self.aligned.sensors.values(), *reference.values())]
        return MethodScore(
            self.test.name,
            method,
            int(np.count_nonzero(np.all(known, axis=0))),
            {s: rms(rotation.angle_between(estimates[s], reference[s])) for s in chain.segments},
            {j: rms(np.arctan2(np.sin(angle), np.cos(angle))) for j, angle in off.items()},
            flexion,
        )


def _inner(chain: Chain) -> Iterable[tuple[str, str, str]]:
    names = chain.segments
    return [
        (joint.name, names[joint.proximal], names[joint.distal]) for joint in inner_joints(chain)
    ]


def _flexion(above: Array, below: Array, axis: Array) -> Array:
    angle: Array = swing_twist(joint_rotation(above, below), axis)[1]
    return angle
