"""Interface of the models that estimate the orientation of one segment from its sensors.

A model is frozen plain data with an exact JSON form. Each model is trained for one ordered set of
sensors. A segment has one model for each set of sensors that can be available. The inputs are
bone-aligned orientations ``q_world_segment``, one for each sensor, computed with its
sensor-to-segment alignment from the static pose.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from math import radians
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from typing_extensions import override  # in typing from Python 3.12 on

from jointfit_daemon.limb_model._json_form import fields_form

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion, Vector


FEW_MOVEMENTS = 3
"""Smallest number of training movements with which the standard deviation of a prediction is not
increased.
"""
FEW_MOVEMENTS_FACTOR = 2.5
"""Factor by which the standard deviation is increased with fewer training movements. In
measurements, errors on an untrained movement were 2.2 to 2.7 times as large as on trained
movements.
"""


class Prediction(NamedTuple):
    """Estimate of one segment in one frame."""

    q: Quaternion
    """Estimated orientation q_world_segment."""
    sd: float
    """Standard deviation of the orientation per axis (root mean variance), rad."""
    extrapolating: bool
    """Whether the posture is outside the training range."""
    axis_sd: Vector | None = None
    """Standard deviations about x, y and z of the segment, rad; None if unknown."""


class SegmentModel(ABC):
    """Model of the orientation of one segment for a fixed set of its sensors."""

    kind: ClassVar[str] = ""
    """Name of the model in its JSON form."""
    _kinds: ClassVar[dict[str, type[SegmentModel]]] = {}

    residual_sd: float
    """RMS residual per axis on frames that were not used by the fit, rad."""

    @override
    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        SegmentModel._kinds[cls.kind] = cls

    @abstractmethod
    def predict(self, sensors: Sequence[ArrayLike], q_other: ArrayLike | None = None) -> Array:
        """Return q_world_segment of every frame, shape (n, 4); NaN if an input is NaN.

        Parameters
        ----------
        sensors : sequence of array_like, shape (n, 4)
            One array for each sensor, in the order of training.
        q_other : array_like, shape (n, 4), optional
            Orientation of the neighboring segment.
        """

    @abstractmethod
    def predict_one(
        self, sensors: Sequence[Quaternion], q_other: Quaternion | None = None
    ) -> Prediction:
        """Return the estimate of one frame from plain tuples."""

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form, which is exact even after a conversion to text."""
        return {"kind": self.kind, **fields_form(self)}

    @classmethod
    @abstractmethod
    def read(cls, data: Mapping[str, Any]) -> SegmentModel:
        """Return the model from the JSON form of this class."""

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> SegmentModel:
        """Return the model from the JSON form of any model class.

        Raises
        ------
        ValueError
            The kind is unknown.
        KeyError
            A key is missing.
        """
        kind = data["kind"]
        if kind not in SegmentModel._kinds:
            raise ValueError(f"segment model {kind!r}; known: {', '.join(SegmentModel._kinds)}")
        return SegmentModel._kinds[kind].read(data)


def widen_sd(sd: float, movements: int) -> float:
    """Return `sd`, increased if the training data contain few distinct movements."""
    return sd if movements >= FEW_MOVEMENTS else sd * FEW_MOVEMENTS_FACTOR


UNREFERENCED_SD = radians(10.0)
"""Standard deviation of a segment without optical reference, rad. It is the order of magnitude of
the soft-tissue artefact on thigh and shank.
"""
