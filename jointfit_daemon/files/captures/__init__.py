"""Recorded device traffic: pcap, pcapng, candump text and raw bytes."""

from jointfit_daemon.files.captures._candump import frame_sizes, pack_can_frame
from jointfit_daemon.files.captures._capture import UnreadableCaptureError, read_capture

__all__ = ["UnreadableCaptureError", "frame_sizes", "pack_can_frame", "read_capture"]
