"""Recorded device traffic: pcap, pcapng, candump text and raw bytes."""

from jointfit_daemon.files.captures._candump import pack_can_frame
from jointfit_daemon.files.captures._capture import read_capture

__all__ = ["pack_can_frame", "read_capture"]
