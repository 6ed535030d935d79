"""Alignment: sample streams interpolated to frames at a fixed rate."""

from jointfit_daemon.timing.alignment._frame_aligner import AlignedFrame, FrameAligner, Mode
from jointfit_daemon.timing.alignment._interpolation import CURVATURE_SHARE, extrapolate_orientation

__all__ = ["CURVATURE_SHARE", "AlignedFrame", "FrameAligner", "Mode", "extrapolate_orientation"]
