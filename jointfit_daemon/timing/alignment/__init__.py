"""Alignment of sample streams to frames at a fixed rate, by interpolation."""

from jointfit_daemon.timing.alignment._frame_aligner import AlignedFrame, FrameAligner, Mode
from jointfit_daemon.timing.alignment._interpolation import CURVATURE_SHARE, extrapolate_orientation
from jointfit_daemon.timing.alignment._rate_divider import RateDivider

__all__ = [
    "CURVATURE_SHARE",
    "AlignedFrame",
    "FrameAligner",
    "Mode",
    "RateDivider",
    "extrapolate_orientation",
]
