"""Alignment: sample streams interpolated to frames at a fixed rate."""

from jointfit_daemon.timing.alignment._frame_aligner import (
    AlignedFrame,
    FrameAligner,
    Mode,
    StreamSpec,
)
from jointfit_daemon.timing.alignment._interpolation import BEND, beyond

__all__ = ["BEND", "AlignedFrame", "FrameAligner", "Mode", "StreamSpec", "beyond"]
