"""One segment's orientation from whatever of its sensors are alive.

Law: no jump, and no silence unsaid.

The order is: the model trained for exactly the sensors alive, the plain mean of them, the last
orientation for a fifth of a second, nothing. When the set alive changes, the difference between
what was said and what is now to be said fades over a quarter of a second.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING

from jointfit_daemon.calibration.result import alive_key
from jointfit_daemon.calibration.static_pose import UNREFERENCED_SD
from jointfit_daemon.kinematics.rotation_scalar import (
    between_one,
    exp_one,
    log_one,
    multiply_one,
    normalize_one,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.calibration.redundancy import SegmentModel
    from jointfit_daemon.calibration.result import SegmentCalibration
    from jointfit_daemon.model import Quaternion, Vector

FLOOR_SD = 0.0005
"""No orientation is claimed to be better than this, rad."""
BLEND_NS = 250_000_000
HOLD_NS = 200_000_000
HELD_RATE = 2.0
"""How fast a held orientation goes out of date, rad/s: the RMS rate of a walking leg."""

Inputs = dict[str, "Quaternion"]
"""q_optical_segment by sensor: what each alive sensor alone says."""


@dataclass(frozen=True, slots=True)
class Fused:
    """What is said of one segment in one frame."""

    q: Quaternion | None
    sd: float | None
    used: tuple[str, ...]
    flags: tuple[str, ...]


class SegmentFuser:
    """Says a segment's orientation, frame by frame.

    Parameters
    ----------
    name : str
        Of the segment; appears in flags.
    sensors : sequence of str
        Its sensors, in the order in which the models were trained.
    calibration : SegmentCalibration
        Models by alive set.
    """

    def __init__(self, name: str, sensors: Sequence[str], calibration: SegmentCalibration) -> None:
        self._name, self._sensors = name, tuple(sensors)
        self._models = calibration.models
        widest = max((m.residual_sd for m in self._models.values()), default=UNREFERENCED_SD)
        self._untrained_sd = max(widest, FLOOR_SD)
        self._last: tuple[int, Quaternion, float] | None = None
        self._before: tuple[tuple[str, ...], str | None, Inputs] | None = None
        self._fading: tuple[int, Vector] | None = None

    def fuse(self, t_ns: int, inputs: Inputs, neighbor: Sequence[str]) -> Fused:
        """Say the orientation at `t_ns`.

        Parameters
        ----------
        inputs : dict
            q_optical_segment that each alive sensor of the limb says of its own segment.
        neighbor : sequence of str
            Sensors of the segment whose movement the models look at.
        """
        alive = tuple([s for s in self._sensors if s in inputs])
        if not alive:
            return self._hold(t_ns)
        other = next((s for s in neighbor if s in inputs), None)
        target, sd, outside = self._say(alive, other, inputs)
        self._note_change(t_ns, alive, other, inputs, target)
        q = self._faded(t_ns, target)
        self._last, self._before = (t_ns, q, sd), (alive, other, inputs)
        return Fused(q, sd, alive, self._flags(alive, outside))

    def _flags(self, alive: tuple[str, ...], outside: bool) -> tuple[str, ...]:
        few = len(alive) == 1 and len(self._sensors) > 1
        if not few and not outside:
            return ()
        flags = (f"one_sensor:{self._name}",) if few else ()
        return (*flags, f"untrained:{self._name}") if outside else flags

    def _hold(self, t_ns: int) -> Fused:
        if self._last is None or t_ns - self._last[0] > HOLD_NS:
            self._before = self._fading = None
            return Fused(None, None, (), (f"lost:{self._name}",))
        since, q, sd = self._last
        age_s = (t_ns - since) * 1e-9
        wide = sqrt(sd * sd + (HELD_RATE * age_s) ** 2)
        return Fused(q, wide, (), (f"held:{self._name}",))

    def _say(
        self, alive: tuple[str, ...], other: str | None, inputs: Inputs
    ) -> tuple[Quaternion, float, bool]:
        """Return orientation, standard deviation and whether the movement is outside training."""
        model = self._models.get(alive_key(alive, other))
        if model is not None:
            return _predict(model, alive, other, inputs)
        model = self._models.get(alive_key(alive, None))
        if model is not None:
            return _predict(model, alive, None, inputs)
        return mean_one([inputs[s] for s in alive]), self._untrained_sd, False

    def _note_change(
        self,
        t_ns: int,
        alive: tuple[str, ...],
        other: str | None,
        inputs: Inputs,
        target: Quaternion,
    ) -> None:
        """Begin to fade when the set alive is another than in the frame before."""
        if self._last is None or t_ns - self._last[0] > HOLD_NS or self._before is None:
            self._fading = None
            return
        was_alive, was_other, was_inputs = self._before
        if (alive, other) == (was_alive, was_other):
            return
        if all(s in inputs for s in was_alive) and (was_other is None or was_other in inputs):
            # the old set still speaks: what would it have said now?
            old = self._faded(t_ns, self._say(was_alive, was_other, inputs)[0])
            offset = log_one(between_one(target, old))
        elif all(s in was_inputs for s in alive) and (other is None or other in was_inputs):
            # the new set spoke before: what would it have said then?
            then = self._say(alive, other, was_inputs)[0]
            offset = log_one(between_one(then, self._last[1]))
        else:
            offset = log_one(between_one(target, self._last[1]))
        self._fading = (t_ns, offset)

    def _faded(self, t_ns: int, target: Quaternion) -> Quaternion:
        if self._fading is None:
            return target
        began, (x, y, z) = self._fading
        left = 1.0 - (t_ns - began) / BLEND_NS
        if left <= 0.0:
            self._fading = None
            return target
        return multiply_one(target, exp_one((left * x, left * y, left * z)))


def _predict(
    model: SegmentModel, alive: tuple[str, ...], other: str | None, inputs: Inputs
) -> tuple[Quaternion, float, bool]:
    o = inputs[other] if other is not None else None
    said = model.predict_one([inputs[s] for s in alive], o)
    return said.q, max(said.sd, FLOOR_SD), said.extrapolating


def mean_one(orientations: Sequence[Quaternion]) -> Quaternion:
    """Return the mean of a few orientations that lie within 90° of each other, equal weights.

    Sum of the quaternions on the first one's side, normalised: for two it is the eigenvector mean
    (Markley et al. 2007) exactly, for more it differs in the third order of their distances.
    """
    first = orientations[0]
    w, x, y, z = first
    for q in orientations[1:]:
        same = q[0] * first[0] + q[1] * first[1] + q[2] * first[2] + q[3] * first[3] >= 0.0
        sign = 1.0 if same else -1.0
        w, x, y, z = w + sign * q[0], x + sign * q[1], y + sign * q[2], z + sign * q[3]
    return normalize_one((w, x, y, z))
