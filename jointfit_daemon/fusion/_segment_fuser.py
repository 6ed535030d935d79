"""One segment's orientation from whatever of its sensors are alive.

Law: no jump, and no silence unsaid.

The order is: the model trained for exactly the sensors alive, the plain mean of them, the last
orientation for a fifth of a second, nothing. When the set alive changes, the difference between
what was said and what is now to be said fades over a quarter of a second.
"""

from __future__ import annotations

from math import radians, sqrt
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.kinematics.rotation_scalar import normalize_one, turn_one, turned_one
from jointfit_daemon.limb_model import UNREFERENCED_SD, Prediction, alive_key

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.limb_model import SegmentCalibration, SegmentModel
    from jointfit_daemon.model import Quaternion, Vector

FLOOR_SD = 0.0005
"""No orientation is claimed to be better than this, rad."""
HEADING_SD = radians(2.0)
"""How far the heading of a sensor's world has wandered from where the calibration found it, rad: a
turn about the vertical, common to a segment's pair, that no training frame shows (measured on
simulated people a minute after calibration). It hardly touches flexion."""
HEADING_WANDER = radians(0.3)
"""How it goes on wandering, rad per root of a minute: after an hour the deviation has doubled."""
_HEADING_VAR, _WANDER_VAR = HEADING_SD * HEADING_SD, HEADING_WANDER * HEADING_WANDER
BLEND_NS = 250_000_000
LEARNED_NS = 1_000_000_000
"""How long models that were learned while running take to replace those before them."""
HOLD_NS = 200_000_000
MINUTE_NS = 60_000_000_000
HELD_RATE = 2.0
"""How fast a held orientation goes out of date, rad/s: the RMS rate of a walking leg."""

Inputs = dict[str, "Quaternion"]
"""q_optical_segment by sensor: what each alive sensor alone says."""
Names = tuple[str, ...]


class Fused(NamedTuple):
    """What is said of one segment in one frame."""

    q: Quaternion | None
    sd: float | None
    used: tuple[str, ...]
    flags: tuple[str, ...]
    flexion_sd: float | None = None
    """Standard deviation about the segment's x, rad, where its model tells the axes apart."""
    doubt: float = 0.0
    """Standard deviation per axis, rad, that who watches the sensors adds: `sd` has it already."""


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
        self._models_before: Mapping[str, SegmentModel] | None = None
        self._chosen: dict[tuple[Names, Names], tuple[SegmentModel | None, Names]] = {}
        """By sensors alive, here and on the neighbor: the model, and whom it looks at there."""
        self._use(self._models)
        self._since_ns: int | None = None
        self._last: tuple[int, Quaternion, float] | None = None
        self._before: tuple[Names, Names, Inputs] | None = None
        self._fading: tuple[int, int, Vector] | None = None

    def take(self, models: Mapping[str, SegmentModel]) -> None:
        """Go over to other models of the same sensors: what they say otherwise comes slowly."""
        if self._models_before is None:
            self._models_before = self._models
        self._use(models)

    def worn_since(self, t_ns: int) -> None:
        """Count the wandering of headings from `t_ns` on, and not from the first frame."""
        self._since_ns = t_ns

    def _use(self, models: Mapping[str, SegmentModel]) -> None:
        widest = max((m.residual_sd for m in models.values()), default=UNREFERENCED_SD)
        self._models, self._untrained_sd = models, max(widest, FLOOR_SD)
        self._chosen.clear()

    def fuse(self, t_ns: int, inputs: Inputs, neighbor: Sequence[str]) -> Fused:
        """Say the orientation at `t_ns`.

        Parameters
        ----------
        inputs : dict
            q_optical_segment that each alive sensor of the limb says of its own segment.
        neighbor : sequence of str
            Sensors of the segment whose movement the models look at; the same ones every time.
        """
        before = self._before
        if before is not None and inputs.keys() == before[2].keys():
            alive, near, _ = before  # as nearly always
        else:
            alive, near = _heard(self._sensors, inputs), _heard(tuple(neighbor), inputs)
        if not alive:
            return self._hold(t_ns)
        if self._models_before is not None:
            self._go_over(t_ns, alive, near, inputs)
        said = self._say(alive, near, inputs)
        self._note_change(t_ns, alive, near, inputs, said.q)
        q = self._faded(t_ns, said.q)
        if self._since_ns is None:
            self._since_ns = t_ns
        flexion_sd, sd = _claimed(said, (t_ns - self._since_ns) / MINUTE_NS)
        self._last, self._before = (t_ns, q, sd), (alive, near, inputs)
        return Fused(q, sd, alive, self._flags(alive, said.extrapolating), flexion_sd)

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

    def _say(self, alive: Names, near: Names, inputs: Inputs) -> Prediction:
        """Return what the model of this set says: with the neighbor, without, or the plain mean."""
        chosen = self._chosen.get((alive, near))
        if chosen is None:
            chosen = self._chosen[alive, near] = self._choose(alive, near)
        model, others = chosen
        sensors = [inputs[s] for s in alive]
        if model is None:
            return Prediction(mean_one(sensors), self._untrained_sd, False)
        if not others:
            return model.predict_one(sensors)
        return model.predict_one(sensors, mean_one([inputs[s] for s in others]))

    def _choose(self, alive: Names, near: Names) -> tuple[SegmentModel | None, Names]:
        """Return the model for a set, and which sensors of the neighbor it looks at."""
        for others in (near, near[:1], ()):
            model = self._models.get(alive_key(alive, "+".join(others) or None))
            if model is not None:
                return model, others
        return None, ()

    def _go_over(self, t_ns: int, alive: Names, near: Names, inputs: Inputs) -> None:
        """Begin to fade from what the models before would say of this frame."""
        newer, older = self._models, self._models_before
        self._models_before = None
        if older is None or self._last is None or t_ns - self._last[0] > HOLD_NS:
            return
        self._use(older)
        said = self._say(alive, near, inputs).q
        self._note_change(t_ns, alive, near, inputs, said)
        old = self._faded(t_ns, said)
        self._use(newer)
        offset = turn_one(self._say(alive, near, inputs).q, old)
        self._fading, self._before = (t_ns, LEARNED_NS, offset), (alive, near, inputs)

    def _note_change(
        self,
        t_ns: int,
        alive: Names,
        near: Names,
        inputs: Inputs,
        target: Quaternion,
    ) -> None:
        """Begin to fade when the set alive is another than in the frame before."""
        if self._last is None or t_ns - self._last[0] > HOLD_NS or self._before is None:
            self._fading = None
            return
        was_alive, was_near, was_inputs = self._before
        if (alive, near) == (was_alive, was_near):
            return
        if all(s in inputs for s in (*was_alive, *was_near)):
            # the old set still speaks: what would it have said now?
            old = self._faded(t_ns, self._say(was_alive, was_near, inputs).q)
            offset = turn_one(target, old)
        elif all(s in was_inputs for s in (*alive, *near)):
            # the new set spoke before: what would it have said then?
            then = self._say(alive, near, was_inputs).q
            offset = turn_one(then, self._last[1])
        else:
            offset = turn_one(target, self._last[1])
        self._fading = (t_ns, BLEND_NS, offset)

    def _faded(self, t_ns: int, target: Quaternion) -> Quaternion:
        if self._fading is None:
            return target
        began, length, (x, y, z) = self._fading
        left = 1.0 - (t_ns - began) / length
        if left <= 0.0:
            self._fading = None
            return target
        return turned_one(target, (left * x, left * y, left * z))


def _heard(names: Names, inputs: Inputs) -> Names:
    """Return those who say something: mostly all, and then nothing is made anew."""
    for name in names:
        if name not in inputs:
            return tuple([s for s in names if s in inputs])
    return names


def _claimed(said: Prediction, minutes: float) -> tuple[float | None, float]:
    """Return the standard deviations about x and overall, with what no training can show.

    A heading wanders about the vertical, one axis of three; `minutes` is the age of the
    calibration with its static pose.
    """
    sd = max(said.sd, FLOOR_SD)
    heading = _HEADING_VAR + _WANDER_VAR * max(minutes, 0.0)
    sd = sqrt(sd * sd + heading / 3.0)
    return None if said.axis_sd is None else max(said.axis_sd[0], FLOOR_SD), sd


def mean_one(orientations: Sequence[Quaternion]) -> Quaternion:
    """Return the mean of a few orientations that lie within 90° of each other, equal weights.

    Sum of the quaternions on the first one's side, normalised: for two it is the eigenvector mean
    (Markley et al. 2007) exactly, for more it differs in the third order of their distances.
    """
    w, x, y, z = a, b, c, d = orientations[0]
    for p, i, j, k in orientations[1:]:
        if p * a + i * b + j * c + k * d >= 0.0:
            w, x, y, z = w + p, x + i, y + j, z + k
        else:
            w, x, y, z = w - p, x - i, y - j, z - k
    return normalize_one((w, x, y, z))
