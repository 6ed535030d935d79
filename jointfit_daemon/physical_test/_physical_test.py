"""Physical test of one sensor: steps, rests that end the steps, and settings that fit the test.

The chunks are stored, so that other values of the keys `direction` and `world` can be tried with
the same movement.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.model import ImuSample
from jointfit_daemon.physical_test._frame_evaluation import explain_frames, fit_frames
from jointfit_daemon.physical_test._rest_finder import RestFinder

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.config import Source
    from jointfit_daemon.model import Chunk, Quaternion

STEPS = (
    "Lay {id} flat, its z axis up, and let go.",
    "Turn it on the table by a quarter turn, counter-clockwise seen from above, and let go.",
    "Tip it by a quarter turn about its x axis, so that its y axis points up, and hold it still.",
    "Turn it, as it stands, by a quarter turn, counter-clockwise seen from above.",
)
"""Instructions for the user. The sensor must be at rest after each step."""
_KEYS = ("direction", "world")
"""Keys of a driver that change the interpretation of quaternions."""


@dataclass(frozen=True, slots=True)
class PhysicalTestResult:
    """Outcome of the test of one sensor."""

    id: str
    agrees: bool
    """Whether world, axes and direction are as configured."""
    deviations_deg: tuple[float, float, float]
    """Deviation of each measured rotation from the requested rotation, deg."""
    found: str
    """Text that describes the convention of the received quaternions."""
    rig_toml: tuple[str, ...]
    """Keys of the ``[[imu]]`` table that correct the orientations. Empty if no correction is needed
    or none exists.
    """
    alternatives: tuple[str, ...]
    """Other corrections that fit equally well and differ only by the heading."""


class PhysicalTest:
    """Test of one sensor, which processes the chunks of the sensor.

    Parameters
    ----------
    source
        Sensor of a rig.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self.rests: list[tuple[int, int]] = []
        """Begin and end of each rest, ns, with one rest for each completed step."""
        self.has_orientation = False
        """Whether the sensor has sent an orientation."""
        self._decoder = source.driver_class(source.settings).decoder()
        self._finder: RestFinder | None = None
        self._chunks: list[Chunk] = []

    @property
    def instruction(self) -> str | None:
        """Instruction of the current step; None after the last step."""
        done = len(self.rests)
        return STEPS[done].format(id=self.source.id) if done < len(STEPS) else None

    def begin(self) -> None:
        """Start to accept rests. Rests before this call do not count."""
        self._finder = RestFinder()

    def add(self, chunk: Chunk) -> None:
        """Add a chunk of the sensor; a rest within the chunk ends the current step."""
        if len(self.rests) == len(STEPS):
            return
        self._chunks.append(chunk)
        for item in self._decoder.feed(chunk):
            if not isinstance(item, ImuSample):
                continue
            self.has_orientation = True
            if self._finder is None or len(self.rests) == len(STEPS):
                continue
            rest = self._finder.add(item.arrival_ns, item.q_world_sensor)
            if rest is not None:
                self.rests.append(rest)

    def result(self) -> PhysicalTestResult:
        """Evaluate the complete test. All chunks are decoded once for each setting to try."""
        return evaluate_recording(self.source, self._chunks, self.rests)


def evaluate_recording(
    source: Source, chunks: Sequence[Chunk], rests: Sequence[tuple[int, int]]
) -> PhysicalTestResult:
    """Evaluate a recorded test, and find the settings that fit the test.

    Parameters
    ----------
    source
        Sensor of a rig.
    chunks
        All chunks of the sensor, in order.
    rests
        Begin and end of each rest, ns.
    """
    poses, received = _poses(source, source.settings, chunks, rests)
    fit = fit_frames(poses)
    one, two, three = np.degrees(fit.deviations_rad).tolist()
    corrections: list[str] = []
    if not fit.agrees:
        for change in _other_settings(source.settings):
            changed = source.settings.model_copy(update=change)
            if fit_frames(_poses(source, changed, chunks, rests)[0]).agrees:
                corrections.append("\n".join(f'{key} = "{value}"' for key, value in change.items()))
    return PhysicalTestResult(
        id=source.id,
        agrees=fit.agrees,
        deviations_deg=(one, two, three),
        found=explain_frames(received),
        rig_toml=tuple(corrections[:1]),
        alternatives=tuple(corrections[1:]),
    )


def _other_settings(settings: Any) -> list[dict[str, str]]:
    """Return all other choices of the keys `_KEYS`, the choices with the fewest changes first."""
    fields = type(settings).model_fields
    choices = {key: get_args(fields[key].annotation) for key in _KEYS if key in fields}
    all_values = [dict(zip(choices, values, strict=True)) for values in product(*choices.values())]
    changes = [
        {key: value for key, value in each.items() if value != getattr(settings, key)}
        for each in all_values
    ]
    return sorted((change for change in changes if change), key=len)


def _poses(
    source: Source, settings: Any, chunks: Sequence[Chunk], rests: Sequence[tuple[int, int]]
) -> tuple[Array, Array]:
    """Return the mean canonical and mean received quaternions of the rests, (4, 4) each."""
    decoder = source.driver_class(settings).decoder()
    canonical: list[list[Quaternion]] = [[] for _ in rests]
    received: list[list[Quaternion]] = [[] for _ in rests]
    for chunk in chunks:
        for item in decoder.feed(chunk):
            if not isinstance(item, ImuSample):
                continue
            for number, (begin_ns, end_ns) in enumerate(rests):
                if begin_ns <= item.arrival_ns <= end_ns:
                    canonical[number].append(item.q_world_sensor)
                    received[number].append(item.q_native)

    means = [rotation.average(np.array(poses)) for poses in canonical]
    native = [rotation.average(rotation.normalize(np.array(poses))) for poses in received]
    return np.array(means), np.array(native)
