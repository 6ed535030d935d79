"""Orientation of one segment from the sensors that have data.

If a model was trained for exactly these sensors, the output is the prediction of this model.
Otherwise it is the mean of these sensors. Without sensors it is the last orientation for 0.2 s,
then None. If the set of sensors changes, the output moves from the old to the new orientation
within 0.25 s:

- If a sensor returns, all sensors of the old set and of the new set have data, and the predictions
  of the two sets are blended. The first sample of a returning sensor is often wrong, but the new
  set has a small weight in the frame of this sample.
- If a sensor is lost, the difference between the predictions of the two sets in the previous frames
  is faded out. The difference in the last of these frames is ignored if it contradicts the
  differences in the frames before.

Invariant: every degradation sets a flag. The orientation jumps only in the frame after a wrong
sample.
"""

from __future__ import annotations

from collections import deque
from math import dist, radians, sqrt
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.kinematics.rotation_scalar import (
    difference_one,
    interpolate_one,
    normalize_one,
    perturb_one,
)
from jointfit_daemon.limb_model import UNREFERENCED_SD, Prediction, model_key
from jointfit_daemon.model import FrameFlag

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.limb_model import SegmentCalibration, SegmentModel
    from jointfit_daemon.model import Quaternion, Vector

MIN_SD = 0.0005
"""Smallest standard deviation of an orientation, rad; it is the resolution of common sensors."""
HEADING_SD = radians(2.0)
"""Standard deviation of the heading of a sensor's world just after calibration, rad. The value was
measured on simulated subjects one minute after calibration. The error is common to the sensors of a
segment, so the training data do not show it. The error hardly affects flexion.
"""
HEADING_WALK = radians(0.3)
"""Random walk of the heading of a sensor's world, rad per square root of a minute. After an hour
the standard deviation is about 3°.
"""
_HEADING_VAR, _WALK_VAR = HEADING_SD * HEADING_SD, HEADING_WALK * HEADING_WALK
FADE_NS = 250_000_000
"""Fade time after a change of the set of sensors, ns."""
MODEL_FADE_NS = 1_000_000_000
"""Fade time after a change of the models by online learning, ns."""
OUTLIER = radians(3.0)
"""Limit for the last frame before a sensor was lost, rad. The rotation from the prediction of the
remaining sensors to the output is computed in each of the last five frames. If the rotation in the
last frame differs from the median by more than this limit, the last frame counts as wrong.
Soft-tissue artefact changes the rotation by at most a third of the limit.
"""
_HISTORY = 5
"""Number of stored frames. The median of five frames is correct even if two frames are wrong."""
HOLD_NS = 200_000_000
"""Time for which the last orientation is held if no sensor has data, ns."""
MINUTE_NS = 60_000_000_000
HELD_RATE = 2.0
"""Growth of the standard deviation of a held orientation, rad/s. It is the RMS angular rate of the
leg in gait.
"""

Inputs = dict[str, "Quaternion"]
"""Orientation q_optical_segment by sensor, computed from this sensor alone."""
Names = tuple[str, ...]


class FusedSegment(NamedTuple):
    """Orientation of one segment in one frame."""

    q: Quaternion | None
    sd: float | None
    """Standard deviation per axis, rad."""
    used: tuple[str, ...]
    """Sensors that contributed."""
    flags: tuple[str, ...]
    flexion_sd: float | None = None
    """Standard deviation about the x axis of the segment, rad; None if the model has one value for
    all axes.
    """
    fault_sd: float = 0.0
    """Standard deviation per axis caused by inconsistent sensors, rad; included in `sd`."""


class _Blend(NamedTuple):
    """A set of sensors that is being faded out after a sensor returned."""

    start_ns: int
    alive: Names
    """Sensors of the segment in this set."""
    near: Names
    """Sensors of the neighboring segment in this set."""


class SegmentFuser:
    """Computes the orientation of one segment, frame by frame.

    Parameters
    ----------
    name : str
        Name of the segment, for flags.
    sensors : sequence of str
        Sensors of the segment, in the order in which the models were trained.
    calibration : SegmentCalibration
        Models by set of sensors.
    """

    def __init__(self, name: str, sensors: Sequence[str], calibration: SegmentCalibration) -> None:
        self._name, self._sensors = name, tuple(sensors)
        self._models = calibration.models
        self._replaced_models: Mapping[str, SegmentModel] | None = None
        self._chosen: dict[tuple[Names, Names], tuple[SegmentModel | None, Names]] = {}
        """Chosen model, and the sensors of the neighboring segment that this model uses. The key
        contains the sensors with data on the segment and on the neighboring segment.
        """
        self._use(self._models)
        self._calibrated_ns: int | None = None
        self._last: tuple[int, Quaternion, float] | None = None
        self._before: tuple[Names, Names, Inputs] | None = None
        self._fading: tuple[int, int, Vector] | None = None
        """Start and length of the current fade, ns, and its initial rotation vector, rad."""
        self._blends: list[_Blend] = []
        """Sets of sensors that are being faded out, the oldest first; `_fading` belongs to the
        oldest."""
        self._history: deque[tuple[Inputs, Quaternion]] = deque(maxlen=_HISTORY)
        """Inputs and output of the last frames."""

    def replace_models(self, models: Mapping[str, SegmentModel]) -> None:
        """Use other models of the same sensors, with a fade of the output."""
        if self._replaced_models is None:
            self._replaced_models = self._models
        self._use(models)

    def set_calibration_time(self, t_ns: int) -> None:
        """Set the instant from which heading uncertainty grows; default is the first frame."""
        self._calibrated_ns = t_ns

    def _use(self, models: Mapping[str, SegmentModel]) -> None:
        largest = max((m.residual_sd for m in models.values()), default=UNREFERENCED_SD)
        self._models, self._untrained_sd = models, max(largest, MIN_SD)
        self._chosen.clear()

    def fuse(self, t_ns: int, inputs: Inputs, neighbor: Sequence[str]) -> FusedSegment:
        """Return the orientation at `t_ns`.

        Parameters
        ----------
        t_ns : int
            Instant of the frame.
        inputs : dict
            Orientation q_optical_segment computed from each sensor of the limb that has data. It is
            the orientation of the segment to which the sensor is attached.
        neighbor : sequence of str
            Sensors of the neighboring segment, whose orientation is an input of the models; must
            not change between calls.
        """
        before = self._before
        if before is not None and inputs.keys() == before[2].keys():
            alive, near, _ = before  # in this usual case, no new tuples are created
        else:
            alive, near = _present(self._sensors, inputs), _present(tuple(neighbor), inputs)
        if not alive:
            return self._hold(t_ns)

        if self._replaced_models is not None:
            self._start_model_fade(t_ns, alive, near, inputs)
        prediction = self._predict(alive, near, inputs)
        self._change_sensors(t_ns, alive, near, inputs, prediction.q)
        q = self._blend_sets(t_ns, inputs, prediction.q)

        sd = self._with_heading_sd(t_ns, prediction.sd)
        flexion_sd = None if prediction.axis_sd is None else max(prediction.axis_sd[0], MIN_SD)
        self._last, self._before = (t_ns, q, sd), (alive, near, inputs)
        self._history.append((inputs, q))

        flags: tuple[str, ...] = ()
        if len(alive) == 1 and len(self._sensors) > 1:
            flags = (FrameFlag.ONE_SENSOR.of(self._name),)
        if prediction.extrapolating:
            flags += (FrameFlag.UNTRAINED.of(self._name),)
        return FusedSegment(q, sd, alive, flags, flexion_sd)

    def _with_heading_sd(self, t_ns: int, sd: float) -> float:
        """Return `sd`, increased by the heading error, which grows with time.

        A heading error is a rotation about one of three axes, so a third of its variance is added
        per axis.
        """
        if self._calibrated_ns is None:
            self._calibrated_ns = t_ns
        minutes = (t_ns - self._calibrated_ns) / MINUTE_NS
        heading = _HEADING_VAR + _WALK_VAR * max(minutes, 0.0)
        sd = max(sd, MIN_SD)
        return sqrt(sd * sd + heading / 3.0)

    def _hold(self, t_ns: int) -> FusedSegment:
        if self._last is None or t_ns - self._last[0] > HOLD_NS:
            self._before = None
            self._stop_fading()
            return FusedSegment(None, None, (), (FrameFlag.LOST.of(self._name),))
        last_ns, q, sd = self._last
        age_s = (t_ns - last_ns) * 1e-9
        held_sd = sqrt(sd * sd + (HELD_RATE * age_s) ** 2)
        return FusedSegment(q, held_sd, (), (FrameFlag.HELD.of(self._name),))

    def _predict(self, alive: Names, near: Names, inputs: Inputs) -> Prediction:
        """Return the prediction of the chosen model, or the mean of the sensors without a model."""
        chosen = self._chosen.get((alive, near))
        if chosen is None:
            # Choose the model for these sensors with the largest known set of neighbor sensors.
            chosen = None, ()
            for others in (near, near[:1], ()):
                model = self._models.get(model_key(alive, "+".join(others) or None))
                if model is not None:
                    chosen = model, others
                    break
            self._chosen[alive, near] = chosen
        model, others = chosen
        sensors = [inputs[s] for s in alive]
        if model is None:
            return Prediction(mean_one(sensors), self._untrained_sd, False)
        if not others:
            return model.predict_one(sensors)
        return model.predict_one(sensors, mean_one([inputs[s] for s in others]))

    def _start_model_fade(self, t_ns: int, alive: Names, near: Names, inputs: Inputs) -> None:
        """Start a fade from the predictions of the old models to the new predictions."""
        new, old = self._models, self._replaced_models
        self._replaced_models = None
        if old is None or self._last is None or t_ns - self._last[0] > HOLD_NS:
            return

        self._use(old)
        prediction = self._predict(alive, near, inputs).q
        self._change_sensors(t_ns, alive, near, inputs, prediction)
        output = self._blend_sets(t_ns, inputs, prediction)
        self._use(new)
        offset = difference_one(self._predict(alive, near, inputs).q, output)
        self._stop_fading()
        self._fading, self._before = (t_ns, MODEL_FADE_NS, offset), (alive, near, inputs)

    def _change_sensors(
        self,
        t_ns: int,
        alive: Names,
        near: Names,
        inputs: Inputs,
        target: Quaternion,
    ) -> None:
        """Start a blend or a fade if the set of sensors changed since the preceding frame."""
        if self._last is None or t_ns - self._last[0] > HOLD_NS or self._before is None:
            self._stop_fading()
            return
        old_alive, old_near, old_inputs = self._before
        if (alive, near) == (old_alive, old_near):
            return

        if all(s in inputs for s in (*old_alive, *old_near)):
            self._blends.append(_Blend(t_ns, old_alive, old_near))
            return
        known = all(s in old_inputs for s in (*alive, *near))
        offset = self._offset_before(alive, near) if known else None
        self._stop_fading()
        self._fading = (t_ns, FADE_NS, offset or difference_one(target, self._last[1]))

    def _offset_before(self, alive: Names, near: Names) -> Vector:
        """Return the rotation from the prediction of a set of sensors to the past output.

        The result is the rotation in the last frame. If this rotation differs too much from the
        median of the last frames, the result is the median.
        """
        offsets = [
            difference_one(self._predict(alive, near, inputs).q, q)
            for inputs, q in self._history
            if all(s in inputs for s in (*alive, *near))
        ]
        x, y, z = (median(values) for values in zip(*offsets, strict=True))
        return (x, y, z) if dist(offsets[-1], (x, y, z)) > OUTLIER else offsets[-1]

    def _stop_fading(self) -> None:
        self._fading = None
        self._blends.clear()
        self._history.clear()

    def _blend_sets(self, t_ns: int, inputs: Inputs, target: Quaternion) -> Quaternion:
        """Return the output, blended from old sets of sensors to the prediction `target`."""
        if self._blends:
            done = [k for k, one in enumerate(self._blends, 1) if t_ns - one.start_ns >= FADE_NS]
            if done:
                del self._blends[: done[-1]]
                self._fading = None
        if not self._blends:
            return self._fade_to(t_ns, target)

        sets = [self._predict(one.alive, one.near, inputs).q for one in self._blends]
        q = self._fade_to(t_ns, sets[0])
        for one, following in zip(self._blends, [*sets[1:], target], strict=True):
            q = interpolate_one(q, following, (t_ns - one.start_ns) / FADE_NS)
        return q

    def _fade_to(self, t_ns: int, target: Quaternion) -> Quaternion:
        if self._fading is None:
            return target
        start_ns, length_ns, (x, y, z) = self._fading
        left = 1.0 - (t_ns - start_ns) / length_ns
        if left <= 0.0:
            self._fading = None
            return target
        return perturb_one(target, (left * x, left * y, left * z))


def _present(names: Names, inputs: Inputs) -> Names:
    """Return the sensors with data; if all have data, return the given tuple."""
    for name in names:
        if name not in inputs:
            return tuple([s for s in names if s in inputs])
    return names


def mean_one(orientations: Sequence[Quaternion]) -> Quaternion:
    """Return the mean of orientations within 90° of each other, with equal weights.

    The mean is the normalized sum of the quaternions, with their signs aligned to the first. For
    two orientations it equals the eigenvector mean of Markley et al. (2007). For more orientations
    the two means differ by terms of third order in the distances of the orientations.
    """
    w, x, y, z = a, b, c, d = orientations[0]
    for p, i, j, k in orientations[1:]:
        if p * a + i * b + j * c + k * d >= 0.0:
            w, x, y, z = w + p, x + i, y + j, z + k
        else:
            w, x, y, z = w - p, x - i, y - j, z - k
    return normalize_one((w, x, y, z))
