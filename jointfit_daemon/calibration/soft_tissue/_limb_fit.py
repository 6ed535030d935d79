"""Fits of the segment models of a limb for every set of available sensors, and their errors.

The evaluation fits the models to the first part of a trial and measures errors on the contiguous
last part. The stored models are then fitted to the whole trial, except in the procedure of the
patent.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from math import isfinite
from typing import TYPE_CHECKING, get_args

import numpy as np

from jointfit_daemon.calibration._quality import HoldoutQuality, MethodErrors, RegressionQuality
from jointfit_daemon.calibration._robust_weights import rms
from jointfit_daemon.calibration.soft_tissue._segment_fit import fit_segment
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import (
    Method,
    PatentModel,
    Procedure,
    angle_convention,
    equal_weights,
    fuse,
    inner_joints,
    model_key,
    neighbor,
)
from jointfit_daemon.model import AngleConvention

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import InnerJoint, SegmentModel
    from jointfit_daemon.model import Chain


METHODS: tuple[Method, ...] = get_args(Method)
"""All fusion methods."""
MAX_SUBSET_SENSORS = 3
"""Largest number of sensors on a segment for which every subset has a model. With more sensors,
only three kinds of subsets have a model: all sensors, all sensors except one, and each single
sensor.
"""


@dataclass(frozen=True, slots=True)
class LimbTraining:
    """Training frames of a limb at common instants."""

    sensors: Mapping[str, Array]
    """q_optical_segment of each sensor, with its sensor-to-segment alignment, shape (n, 4)."""
    reference: Mapping[str, Array]
    """q_optical_segment from optical markers, shape (n, 4)."""
    trials: NDArray[np.int64] | None = None
    """Movement label of each frame, shape (n,); None if there is one movement."""

    def rows(self, chosen: slice | NDArray[np.int64] | NDArray[np.bool_]) -> LimbTraining:
        """Return selected frames."""
        return LimbTraining(
            {name: q[chosen] for name, q in self.sensors.items()},
            {name: q[chosen] for name, q in self.reference.items()},
            None if self.trials is None else self.trials[chosen],
        )

    def __len__(self) -> int:
        return min((len(q) for q in self.reference.values()), default=0)


def sensor_sets(sensors: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Return the sets of sensors of one segment for which a model is fitted, largest first."""
    n = len(sensors)
    sizes = range(n, 0, -1) if n <= MAX_SUBSET_SENSORS else (n, n - 1, 1)
    return [alive for size in sizes for alive in combinations(sensors, size)]


def fit_models(
    chain: Chain, training: LimbTraining, method: Method
) -> dict[str, dict[str, SegmentModel]]:
    """Fit a model of each segment for every set of its own sensors and of its neighbor's sensors.

    Without a neighbor, ``anchored`` is equal to the weighted mean. The other methods do not use the
    neighbor. Their model of a set of sensors is therefore the same for every set of neighbor
    sensors.
    """
    out: dict[str, dict[str, SegmentModel]] = {}
    for i, segment in enumerate(chain.segments):
        reference, models = training.reference[segment], {}
        for alive in sensor_sets(chain.sensors[i]):
            x = [training.sensors[s] for s in alive]
            alone = fit_segment(method, x, None, reference, training.trials)
            models[model_key(alive, None)] = alone

            for near in sensor_sets(neighbor(chain, i)):
                models[model_key(alive, "+".join(near))] = (
                    fit_segment(method, x, mean_of(training, near), reference, training.trials)
                    if method == "anchored"
                    else alone
                )
        out[segment] = models
    return out


def fit_verified_models(
    chain: Chain, training: LimbTraining, method: Method, share: float
) -> dict[str, dict[str, SegmentModel]]:
    """Fit one model of each segment, for all its sensors, to the first part of a trial.

    The source is step S4 of the patent, which uses the coefficients that were fitted to one part of
    the data and verified on the rest. The patent defines no output if some of the sensors are
    missing.
    """
    first, _ = _parts(training, share)
    return {
        segment: {
            model_key(chain.sensors[i], None): fit_segment(
                method,
                [first.sensors[s] for s in chain.sensors[i]],
                None,
                first.reference[segment],
                first.trials,
            )
        }
        for i, segment in enumerate(chain.segments)
    }


def evaluate_methods(
    chain: Chain,
    training: LimbTraining,
    method: Method,
    share: float,
    procedure: Procedure = "corrected",
) -> HoldoutQuality:
    """Evaluate every method and every single sensor on the last `share` of the trial.

    Parameters
    ----------
    method, procedure
        Names of the method and procedure of the calibration, which the result contains.
    """
    first, last = _parts(training, share)
    truth = [last.reference[segment] for segment in chain.segments]
    estimates = {
        m: [
            predict_all_sensors(chain, i, fit_all_sensors(chain, i, m, first), last)
            for i in range(len(chain.segments))
        ]
        for m in METHODS
    }

    def orientation_error(i: int, q: Array) -> float | None:
        return _finite(rms(rotation.angle_between(q, truth[i])))

    def joint_error(joint: InnerJoint, above: Array, below: Array) -> float | None:
        convention = angle_convention(chain, joint.number)
        ends = (truth[joint.proximal], truth[joint.distal])
        return _finite(flexion_error((above, below), ends, convention))

    segments = {
        segment: MethodErrors(
            **{m: orientation_error(i, q[i]) for m, q in estimates.items()},
            sensors={s: orientation_error(i, last.sensors[s]) for s in chain.sensors[i]},
        )
        for i, segment in enumerate(chain.segments)
    }
    joints = {
        j.name: MethodErrors(
            **{m: joint_error(j, q[j.proximal], q[j.distal]) for m, q in estimates.items()},
            sensors={
                f"{a}+{b}": joint_error(j, last.sensors[a], last.sensors[b])
                for a, b in zip(chain.sensors[j.proximal], chain.sensors[j.distal], strict=False)
            },
        )
        for j in inner_joints(chain)
    }
    found = HoldoutQuality(method, share, len(last), segments, joints)
    if procedure == "corrected":
        return found
    meaning = (
        "RMS distance from the optical reference on the last part of the trial, after a fit to the"
        " first part; the stored models are those of this fit"
    )
    return replace(found, procedure=procedure, meaning=meaning)


def regression_quality(
    chain: Chain,
    training: LimbTraining,
    models: Mapping[str, Mapping[str, SegmentModel]],
    share: float,
) -> dict[str, RegressionQuality] | None:
    """Return the regression coefficients of every segment; None if the method has none.

    The patent fits one part of the data and verifies the coefficients on the rest. The verified
    coefficients equal the coefficients of `evaluate_methods`. The stored coefficients are fitted to
    all data, except in the procedure of the patent.

    Parameters
    ----------
    models : mapping
        The stored models of `fit_models` or `fit_verified_models`.
    share : float
        Fraction of the trial that is held out, at its end.
    """
    first, _ = _parts(training, share)
    found = {}
    for i, segment in enumerate(chain.segments):
        stored = models[segment][model_key(chain.sensors[i], None)]
        if not isinstance(stored, PatentModel):
            return None
        verified = fit_all_sensors(chain, i, stored.reading, first)
        if not isinstance(verified, PatentModel):
            return None
        found[segment] = RegressionQuality(
            chain.sensors[i], stored.q_sign, verified.coefficients, stored.coefficients
        )
    return found


def _parts(training: LimbTraining, share: float) -> tuple[LimbTraining, LimbTraining]:
    """Return the first part of a trial, and the last part with the given `share`."""
    cut = round(len(training) * (1.0 - share))
    return training.rows(slice(None, cut)), training.rows(slice(cut, None))


def fit_all_sensors(chain: Chain, i: int, method: Method, training: LimbTraining) -> SegmentModel:
    """Return the model of segment i for all sensors of the segment and of its neighbor."""
    return fit_segment(
        method,
        [training.sensors[s] for s in chain.sensors[i]],
        _neighbor_mean(chain, i, training),
        training.reference[chain.segments[i]],
        training.trials,
    )


def predict_all_sensors(chain: Chain, i: int, model: SegmentModel, frames: LimbTraining) -> Array:
    """Return the orientation of segment i by the model of `fit_all_sensors`, shape (n, 4)."""
    sensors = [frames.sensors[s] for s in chain.sensors[i]]
    return model.predict(sensors, _neighbor_mean(chain, i, frames))


def _neighbor_mean(chain: Chain, i: int, frames: LimbTraining) -> Array | None:
    near = neighbor(chain, i)
    return mean_of(frames, near) if near else None


def mean_of(training: LimbTraining, sensors: Sequence[str]) -> Array:
    """Return the mean of sensors of one segment, shape (n, 4)."""
    return fuse([training.sensors[s] for s in sensors], equal_weights(len(sensors)))


def flexion_error(
    estimate: tuple[Array, Array],
    truth: tuple[Array, Array],
    convention: AngleConvention = AngleConvention.FLEXION,
) -> float:
    """Return the RMS flexion error of a joint, rad, from its proximal and distal segments.

    In the conventions ``elevation`` and ``tilt_torsion``, the result is the error of the elevation,
    because the flexion of a shoulder is not defined at 90 degrees of abduction.
    """
    raised = convention in {AngleConvention.ELEVATION, AngleConvention.TILT_TORSION}
    angle = _elevation if raised else _flexion
    off = angle(*estimate) - angle(*truth)
    return rms(np.arctan2(np.sin(off), np.cos(off)))


def _flexion(q_above: Array, q_below: Array) -> Array:
    """Return phi of R = Rx(phi) Ry(theta) Rz(psi), rad, shape (n,); knee flexion is negative."""
    w, x, y, z = rotation.multiply(rotation.conjugate(q_above), q_below).T
    phi: Array = np.arctan2(2.0 * (w * x - y * z), 1.0 - 2.0 * (x * x + y * y))
    return phi


def _elevation(q_above: Array, q_below: Array) -> Array:
    """Return the angle between the long axes of two segments, rad, shape (n,)."""
    w, x, y, z = rotation.multiply(rotation.conjugate(q_above), q_below).T
    elevation: Array = 2.0 * np.arctan2(np.hypot(x, y), np.hypot(w, z))
    return elevation


def _finite(error: float) -> float | None:
    return error if isfinite(error) else None
