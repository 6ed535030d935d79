"""Recorded device traffic: pcap, pcapng, candump text and raw bytes."""

from jointfit_daemon.files.captures._capture import read_capture

__all__ = ["read_capture"]
