"""Training frames of one segment: bone-aligned sensors with their optical reference."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import ArrayLike, NDArray

    from jointfit_daemon.arrays import Array


FEWEST_FRAMES = 30
"""Smallest number of complete training frames."""


@dataclass(frozen=True, slots=True)
class SegmentTraining:
    """Training frames of one segment with their optical reference; all finite, in order of time."""

    sensors: tuple[Array, ...]
    """Bone-aligned orientations, one array for each sensor, shape (n, 4)."""
    q_other: Array | None
    """Orientation of the neighboring segment from its sensors, shape (n, 4)."""
    q_reference: Array
    """q_world_segment from optical markers, shape (n, 4)."""
    trials: NDArray[np.int64]
    """Movement label of each frame, shape (n,)."""

    @staticmethod
    def of(
        sensors: Sequence[ArrayLike],
        q_other: ArrayLike | None,
        q_reference: ArrayLike,
        trials: ArrayLike | None = None,
    ) -> SegmentTraining:
        """Return the complete frames.

        Raises
        ------
        ValueError
            There is no sensor, or fewer than 30 frames are complete, which is too few for an
            evaluation.
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
        """Return selected frames."""
        other = None if self.q_other is None else self.q_other[chosen]
        sensors = tuple(q[chosen] for q in self.sensors)
        return SegmentTraining(sensors, other, self.q_reference[chosen], self.trials[chosen])

    @property
    def movements(self) -> int:
        """Number of distinct movements."""
        return len(np.unique(self.trials))

    def folds(self, of_one: int = 5) -> Iterator[NDArray[np.bool_]]:
        """Yield masks of held-out blocks, contiguous in time.

        A single trial has `of_one` blocks; each of several trials has three. Random frames are
        unsuitable: neighboring frames are almost identical, so held-out frames would be almost
        identical to frames of the fit.
        """
        labels = np.unique(self.trials)
        blocks = of_one if len(labels) == 1 else 3
        for label in labels:
            for block in np.array_split(np.flatnonzero(self.trials == label), blocks):
                held = np.zeros(len(self), dtype=bool)
                held[block] = True
                yield held


def held_out_sd(
    training: SegmentTraining, predict: Callable[[SegmentTraining, SegmentTraining], Array]
) -> float:
    """Return the RMS error per axis over all held-out blocks of `training`, rad.

    Parameters
    ----------
    predict : callable
        Function that fits a model to its first argument, and returns the predicted orientations of
        its second argument, shape (n, 4).
    """
    squares = []
    for held in training.folds():
        test = training.part(held)
        estimate = predict(training.part(~held), test)
        squares.append(rotation.angle_between(estimate, test.q_reference) ** 2)
    return float(np.sqrt(np.mean(np.concatenate(squares)) / 3.0))
