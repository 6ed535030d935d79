"""Fits of the segment models of a limb for every set of available sensors, and their errors.

The evaluation fits the models to the first part of a trial and measures errors on the contiguous
last part. The stored models are then fitted to the whole trial.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from jointfit_daemon.calibration.soft_tissue._segment_fit import fit_segment
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import Method, flexion_sign, fuse, model_key, neighbor

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import SegmentModel
    from jointfit_daemon.model import Chain


METHODS: tuple[Method, ...] = get_args(Method)
"""All fusion methods."""
MAX_SUBSET_SENSORS = 3
"""With more sensors on a segment, only all sensors, all but one, and each alone get a model."""


@dataclass(frozen=True, slots=True)
class LimbTraining:
    """Training frames of a limb at common instants."""

    sensors: Mapping[str, Array]
    """q_optical_segment of each sensor through its mount, shape (n, 4)."""
    reference: Mapping[str, Array]
    """q_optical_segment from optical markers, shape (n, 4)."""
    trials: NDArray[np.int64] | None = None
    """Movement label of each frame, shape (n,); None if there is one movement."""

    def part(self, chosen: slice) -> LimbTraining:
        """Return a contiguous part."""
        return self.rows(chosen)

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
    """Return the sets of sensors of one segment that get a model, largest first."""
    n = len(sensors)
    sizes = range(n, 0, -1) if n <= MAX_SUBSET_SENSORS else (n, n - 1, 1)
    return [alive for size in sizes for alive in combinations(sensors, size)]


def fit_models(
    chain: Chain, training: LimbTraining, method: Method
) -> dict[str, dict[str, SegmentModel]]:
    """Fit a model of each segment for every set of its sensors and of its neighbor.

    Without a neighbor, ``anchored`` reduces to the weighted mean. The other methods do not use the
    neighbor, so each set of sensors has the same model under every key.
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


def judge(chain: Chain, training: LimbTraining, share: float) -> dict[str, Any]:
    """Evaluate every method and every single sensor on the last `share` of the trial.

    Returns
    -------
    dict
        ``frames``, ``share``; ``segments``: RMS orientation error of each segment and method, rad,
        and of each sensor under ``sensors``; ``flexion``: the same for each inner joint.
    """
    cut = round(len(training) * (1.0 - share))
    first, last = training.part(slice(None, cut)), training.part(slice(cut, None))

    estimates: dict[str, dict[str, Array]] = {}
    for method in METHODS:
        estimates[method] = {
            segment: predict_all_sensors(chain, i, method, first, last)
            for i, segment in enumerate(chain.segments)
        }
    return {
        "share": share,
        "frames": len(last),
        "segments": {
            segment: {
                **{m: _rms_angle(estimates[m][segment], last.reference[segment]) for m in METHODS},
                "sensors": {
                    s: _rms_angle(last.sensors[s], last.reference[segment])
                    for s in chain.sensors[i]
                },
            }
            for i, segment in enumerate(chain.segments)
        },
        "flexion": _flexions(chain, estimates, last),
    }


def predict_all_sensors(
    chain: Chain, i: int, method: Method, first: LimbTraining, last: LimbTraining
) -> Array:
    """Return one segment in `last` by a model of all its sensors, fitted to `first`."""
    segment, sensors = chain.segments[i], chain.sensors[i]
    near = neighbor(chain, i)

    model = fit_segment(
        method,
        [first.sensors[s] for s in sensors],
        mean_of(first, near) if near else None,
        first.reference[segment],
        first.trials,
    )
    return model.predict([last.sensors[s] for s in sensors], mean_of(last, near) if near else None)


def mean_of(training: LimbTraining, sensors: Sequence[str]) -> Array:
    """Return the mean of sensors of one segment, shape (n, 4)."""
    return fuse([training.sensors[s] for s in sensors], (1.0 / len(sensors),) * len(sensors))


def _flexions(
    chain: Chain, estimates: Mapping[str, Mapping[str, Array]], last: LimbTraining
) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for i, joint in enumerate(chain.joints[1:-1]):
        above, below = chain.segments[i], chain.segments[i + 1]
        sign = flexion_sign(joint)
        truth = sign * flexion(last.reference[above], last.reference[below])
        out[joint] = {
            m: _rms_wrapped(sign * flexion(estimates[m][above], estimates[m][below]) - truth)
            for m in METHODS
        }
        out[joint]["sensors"] = {
            f"{a}+{b}": _rms_wrapped(sign * flexion(last.sensors[a], last.sensors[b]) - truth)
            for a, b in zip(chain.sensors[i], chain.sensors[i + 1], strict=False)
        }
    return out


def flexion(q_above: Array, q_below: Array) -> Array:
    """Return phi of R = Rx(phi) Ry(theta) Rz(psi), rad, shape (n,); knee flexion is negative."""
    w, x, y, z = rotation.multiply(rotation.conjugate(q_above), q_below).T
    phi: Array = np.arctan2(2.0 * (w * x - y * z), 1.0 - 2.0 * (x * x + y * y))
    return phi


def _rms_angle(q: Array, reference: Array) -> float | None:
    return _rms(rotation.angle_between(q, reference))


def _rms_wrapped(angle: Array) -> float | None:
    return _rms(np.arctan2(np.sin(angle), np.cos(angle)))


def _rms(values: Array) -> float | None:
    good = values[np.isfinite(values)]
    return float(np.sqrt((good**2).mean())) if good.size else None
