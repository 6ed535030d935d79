"""What every model of a segment can do, and what every fit is given.

Law: a model is frozen plain data with an exact JSON form. It is trained for one set of sensors in
one order; a segment keeps one model for each set that may be alive. Sensors come in bone-aligned:
``q_world_segment`` as each says it, through its static mount.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from math import radians
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from typing_extensions import override  # typing has it from Python 3.12

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.model import Quaternion

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion, Vector


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


def widened(sd: float, movements: int) -> float:
    """Return `sd` as it must be claimed when few kinds of movement were trained."""
    return sd if movements >= FEW_MOVEMENTS else sd * FEW_MOVEMENTS_FACTOR


UNREFERENCED_SD = radians(10.0)
"""Given to a segment that no camera ever judged: skin sensors on thigh and shank move that much."""
