"""Orientation of one segment, computed only by the regression of the patent CN 114533039 B.

Invariant: the orientation of a frame depends only on the sensors of this frame. The orientation is
the regression of all sensors of the segment, or None.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from typing_extensions import override  # in typing from Python 3.12 on

from jointfit_daemon.fusion._segment_fuser import FusedSegment, SegmentFuser
from jointfit_daemon.limb_model import model_key
from jointfit_daemon.model import FrameFlag

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.fusion._segment_fuser import Inputs
    from jointfit_daemon.limb_model import SegmentCalibration, SegmentModel


class PatentSegmentFuser(SegmentFuser):
    """Computes the orientation of one segment by step S4 of the patent, frame by frame.

    Parameters
    ----------
    name : str
        Name of the segment, for flags.
    sensors : sequence of str
        Sensors of the segment, in the order in which the model was trained.
    calibration : SegmentCalibration
        Contains the model of all sensors.
    """

    def __init__(self, name: str, sensors: Sequence[str], calibration: SegmentCalibration) -> None:
        super().__init__(name, sensors, calibration)
        self._key = model_key(self._sensors, None)

    @override
    def replace_models(self, models: Mapping[str, SegmentModel]) -> None:
        """Use other models of the same sensors from the next frame on."""
        self._use(models)

    @override
    def fuse(self, t_ns: int, inputs: Inputs, neighbor: Sequence[str]) -> FusedSegment:
        """Return the regression, or no orientation and the flag ``lost`` if a sensor is missing.

        A regression output with a norm below 0.5 determines no orientation, so the segment is
        ``lost`` and ``untrained``. `neighbor` is ignored, because the regression of the patent does
        not use it.
        """
        lost = FrameFlag.LOST.of(self._name)
        if any(name not in inputs for name in self._sensors):
            return FusedSegment(None, None, (), (lost,))

        prediction = self._models[self._key].predict_one([inputs[s] for s in self._sensors])
        if prediction.extrapolating:
            return FusedSegment(None, None, (), (lost, FrameFlag.UNTRAINED.of(self._name)))
        sd = self._with_heading_sd(t_ns, prediction.sd)
        return FusedSegment(prediction.q, sd, self._sensors, ())
