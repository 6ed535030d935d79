"""What every model of a segment can do, and what every fit is given.

Law: a model is frozen plain data with an exact JSON form. It is trained for one set of sensors in
one order; a segment keeps one model for each set that may be alive. Sensors come in bone-aligned:
``q_world_segment`` as each says it, through its static mount.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from typing_extensions import override  # typing has it from Python 3.12

from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion, Vector

FEWEST_FRAMES = 30

FEW_MOVEMENTS = 3
FEW_MOVEMENTS_FACTOR = 2.5
"""Fewer kinds of movement in training than that: errors elsewhere are this much larger (measured:
2.2 to 2.7 times on a movement that was not trained)."""


class Prediction(NamedTuple):
    """One segment in one frame."""

    q: Quaternion
    """q_world_segment."""
    sd: float
    """Standard deviation of the orientation, rad (root of the mean variance per axis)."""
    extrapolating: bool
    """The pose lies outside what training has shown; treat with care."""
    axis_sd: Vector | None = None
    """Standard deviations about x, y and z of the segment, rad, where they are known apart."""


class SegmentModel(ABC):
    """Orientation of one segment from a fixed set of its sensors."""

    kind: ClassVar[str] = ""
    """Name of the model in its JSON form."""
    _kinds: ClassVar[dict[str, type[SegmentModel]]] = {}

    residual_sd: float
    """RMS per axis, rad, of what the model leaves over on frames it was not fitted to."""

    @override
    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        SegmentModel._kinds[cls.kind] = cls

    @abstractmethod
    def predict(self, sensors: Sequence[ArrayLike], q_other: ArrayLike | None = None) -> Array:
        """Return q_world_segment frame by frame, shape (n, 4); NaN where an input is.

        Parameters
        ----------
        sensors : sequence of array_like, shape (n, 4)
            One array a sensor, in the order of training.
        q_other : array_like, shape (n, 4), optional
            The sensor of the neighbouring segment named in training.
        """

    @abstractmethod
    def predict_one(
        self, sensors: Sequence[Quaternion], q_other: Quaternion | None = None
    ) -> Prediction:
        """Return the same for one frame of plain tuples."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form: exact, also through text."""

    @classmethod
    @abstractmethod
    def read(cls, data: Mapping[str, Any]) -> SegmentModel:
        """Return the model of a JSON form of its own kind."""

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> SegmentModel:
        """Return the model that ``to_dict`` described.

        Raises
        ------
        ValueError
            The kind is unknown.
        KeyError
            Something is missing.
        """
        kind = data["kind"]
        if kind not in SegmentModel._kinds:
            raise ValueError(f"segment model {kind!r}; known: {', '.join(SegmentModel._kinds)}")
        return SegmentModel._kinds[kind].read(data)


@dataclass(frozen=True, slots=True)
class SegmentTraining:
    """Frames of one segment with their optical reference; only finite ones, in order of time."""

    sensors: tuple[Array, ...]
    """Bone-aligned, one array a sensor, shape (n, 4)."""
    q_other: Array | None
    """The neighbouring segment as one of its sensors says it, shape (n, 4)."""
    q_reference: Array
    """q_world_segment by optics, shape (n, 4)."""
    trials: NDArray[np.int64]
    """Which trial, that is kind of movement, each frame belongs to, shape (n,)."""

    @staticmethod
    def of(
        sensors: Sequence[ArrayLike],
        q_other: ArrayLike | None,
        q_reference: ArrayLike,
        trials: ArrayLike | None = None,
    ) -> SegmentTraining:
        """Return the frames of which everything is known.

        Raises
        ------
        ValueError
            There is no sensor, or fewer than 30 frames are complete: too few to judge any fit.
        """
        if not sensors:
            raise ValueError("a segment model needs at least one sensor")
        columns = [*sensors, q_reference] if q_other is None else [*sensors, q_reference, q_other]
        stacked = np.stack([np.asarray(column, dtype=np.float64) for column in columns])
        complete = np.all(np.isfinite(stacked), axis=(0, 2))
        found = int(np.count_nonzero(complete))
        if found < FEWEST_FRAMES:
            raise ValueError(f"{found} complete frames; at least {FEWEST_FRAMES} are needed")
        q = rotation.normalize(stacked[:, complete])
        count = len(sensors)
        labels = np.zeros(len(complete), dtype=np.int64)
        if trials is not None:
            labels = np.asarray(trials, dtype=np.int64)
        other = None if q_other is None else q[count + 1]
        return SegmentTraining(tuple(q[:count]), other, q[count], labels[complete])

    def __len__(self) -> int:
        return len(self.q_reference)

    def part(self, chosen: NDArray[np.bool_]) -> SegmentTraining:
        """Return the chosen frames."""
        other = None if self.q_other is None else self.q_other[chosen]
        sensors = tuple(q[chosen] for q in self.sensors)
        return SegmentTraining(sensors, other, self.q_reference[chosen], self.trials[chosen])

    @property
    def movements(self) -> int:
        """Kinds of movement: trials."""
        return len(np.unique(self.trials))

    def folds(self, of_one: int = 5) -> Iterator[NDArray[np.bool_]]:
        """Yield masks of hold-out blocks, contiguous in time.

        `of_one` blocks of a single trial, three of each of several. Never random frames:
        neighbouring frames are nearly copies, and would tell the fit what it is judged on.
        """
        labels = np.unique(self.trials)
        blocks = of_one if len(labels) == 1 else 3
        for label in labels:
            for block in np.array_split(np.flatnonzero(self.trials == label), blocks):
                held = np.zeros(len(self), dtype=bool)
                held[block] = True
                yield held


def cross_validated_sd(
    training: SegmentTraining, fit: Callable[[SegmentTraining], Callable[[SegmentTraining], Array]]
) -> float:
    """Return the RMS error per axis, rad, over all hold-out blocks of `training`.

    Parameters
    ----------
    fit : callable
        Takes training frames, returns what takes frames and gives their orientations (n, 4).
    """
    squares = []
    for held in training.folds():
        test = training.part(held)
        said = fit(training.part(~held))(test)
        squares.append(rotation.angle_between(said, test.q_reference) ** 2)
    return float(np.sqrt(np.mean(np.concatenate(squares)) / 3.0))


def widened(sd: float, movements: int) -> float:
    """Return `sd` as it must be claimed when few kinds of movement were trained."""
    return sd if movements >= FEW_MOVEMENTS else sd * FEW_MOVEMENTS_FACTOR
