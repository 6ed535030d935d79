"""Redundancy models for every set of sensors that may be alive, and their judgement.

Law: judged on the contiguous last part of the trial, fitted to the first; then fitted again to all
of it. So the figures say what the method does on unseen movement of this kind, and the stored
models are those of all data, which no figure judges.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from jointfit_daemon.calibration.soft_tissue._segment_fit import fit_segment
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import Method, alive_key, flexion_sign, fuse, neighbor

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import SegmentModel
    from jointfit_daemon.model import Chain


METHODS: tuple[Method, ...] = get_args(Method)
MAX_SUBSET_SENSORS = 3
"""With more sensors on a segment only all, all but one and each alone are trained."""


@dataclass(frozen=True, slots=True)
class LimbTraining:
    """What all models of a limb are fitted to, at common instants."""

    sensors: Mapping[str, Array]
    """q_optical_segment as each sensor says it through its bias, shape (n, 4)."""
    reference: Mapping[str, Array]
    """q_optical_segment by optics, shape (n, 4)."""
    trials: NDArray[np.int64] | None = None
    """Which kind of movement each frame belongs to, shape (n,); None: all to one."""

    def part(self, chosen: slice) -> LimbTraining:
        """Return a contiguous part."""
        return self.rows(chosen)

    def rows(self, chosen: slice | NDArray[np.int64] | NDArray[np.bool_]) -> LimbTraining:
        """Return chosen frames."""
        return LimbTraining(
            {name: q[chosen] for name, q in self.sensors.items()},
            {name: q[chosen] for name, q in self.reference.items()},
            None if self.trials is None else self.trials[chosen],
        )

    def __len__(self) -> int:
        return min((len(q) for q in self.reference.values()), default=0)


def alive_sets(sensors: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Return the sets of one segment's sensors that get a model, largest first."""
    n = len(sensors)
    sizes = range(n, 0, -1) if n <= MAX_SUBSET_SENSORS else (n, n - 1, 1)
    return [alive for size in sizes for alive in combinations(sensors, size)]


def fit_models(
    chain: Chain, training: LimbTraining, method: Method
) -> dict[str, dict[str, SegmentModel]]:
    """Fit, per segment, a model for every alive set with every one of its neighbor, and without.

    Without the neighbor only the weighted mean is possible for ``anchored``; the other methods
    never look at it, so each alive set has one model under every key.
    """
    out: dict[str, dict[str, SegmentModel]] = {}
    for i, segment in enumerate(chain.segments):
        reference, models = training.reference[segment], {}
        for alive in alive_sets(chain.sensors[i]):
            x = [training.sensors[s] for s in alive]
            alone = fit_segment(method, x, None, reference, training.trials)
            models[alive_key(alive, None)] = alone
            for near in alive_sets(neighbor(chain, i)):
                models[alive_key(alive, "+".join(near))] = (
                    fit_segment(method, x, mean_of(training, near), reference, training.trials)
                    if method == "anchored"
                    else alone
                )
        out[segment] = models
    return out


def judge(chain: Chain, training: LimbTraining, share: float) -> dict[str, Any]:
    """Judge every method, and every sensor alone, on the last `share` of the trial.

    Returns
    -------
    dict
        ``frames``, ``share``; ``segments``: per segment and method the RMS orientation error, rad,
        and under ``sensors`` that of each alone; ``flexion``: the same per inner joint.
    """
    cut = round(len(training) * (1.0 - share))
    first, last = training.part(slice(None, cut)), training.part(slice(cut, None))
    said: dict[str, dict[str, Array]] = {}
    for method in METHODS:
        said[method] = {
            segment: all_alive(chain, i, method, first, last)
            for i, segment in enumerate(chain.segments)
        }
    return {
        "share": share,
        "frames": len(last),
        "segments": {
            segment: {
                **{m: _rms_angle(said[m][segment], last.reference[segment]) for m in METHODS},
                "sensors": {
                    s: _rms_angle(last.sensors[s], last.reference[segment])
                    for s in chain.sensors[i]
                },
            }
            for i, segment in enumerate(chain.segments)
        },
        "flexion": _flexions(chain, said, last),
    }


def all_alive(
    chain: Chain, i: int, method: Method, first: LimbTraining, last: LimbTraining
) -> Array:
    """Return what one segment's model for all sensors, fitted to `first`, says of `last`."""
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
    """Return the mean of some sensors of one segment, shape (n, 4)."""
    return fuse([training.sensors[s] for s in sensors], (1.0 / len(sensors),) * len(sensors))


def _flexions(
    chain: Chain, said: Mapping[str, Mapping[str, Array]], last: LimbTraining
) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for i, joint in enumerate(chain.joints[1:-1]):
        above, below = chain.segments[i], chain.segments[i + 1]
        sign = flexion_sign(joint)
        truth = sign * flexion(last.reference[above], last.reference[below])
        out[joint] = {
            m: _rms_wrapped(sign * flexion(said[m][above], said[m][below]) - truth) for m in METHODS
        }
        out[joint]["sensors"] = {
            f"{a}+{b}": _rms_wrapped(sign * flexion(last.sensors[a], last.sensors[b]) - truth)
            for a, b in zip(chain.sensors[i], chain.sensors[i + 1], strict=False)
        }
    return out


def flexion(q_above: Array, q_below: Array) -> Array:
    """Return phi of R = Rx(phi) Ry(theta) Rz(psi), rad, shape (n,); knees flex negatively."""
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
