"""CAN frames: records, error frames, and the protocol of SLCAN adapters."""

from jointfit_protocols.can._error_frame import describe_error
from jointfit_protocols.can._frame import (
    EXTENDED_MAX,
    HOST_CORRUPT,
    HOST_DROPPED,
    RECORD_BYTES,
    STANDARD_MAX,
    CanFrame,
    frame_bits,
    host_corrupt,
    host_count,
    host_dropped,
    pack_frames,
    unpack_frames,
)

__all__ = [
    "EXTENDED_MAX",
    "HOST_CORRUPT",
    "HOST_DROPPED",
    "RECORD_BYTES",
    "STANDARD_MAX",
    "CanFrame",
    "describe_error",
    "frame_bits",
    "host_corrupt",
    "host_count",
    "host_dropped",
    "pack_frames",
    "unpack_frames",
]
