"""Wire format of the x-io x-IMU3 over UART or USB: framing, data messages, commands in JSON."""

from jointfit_protocols.ximu3._framing import MAX_LINE, XImu3Codec
from jointfit_protocols.ximu3._messages import (
    BASE_RATE_HZ,
    TICK_NS,
    UNKNOWN_KIND,
    DataKind,
    XImu3Data,
    XImu3Reply,
    encode_command,
    encode_data,
    encode_multiplexed,
    encode_text,
)

__all__ = [
    "BASE_RATE_HZ",
    "MAX_LINE",
    "TICK_NS",
    "UNKNOWN_KIND",
    "DataKind",
    "XImu3Codec",
    "XImu3Data",
    "XImu3Reply",
    "encode_command",
    "encode_data",
    "encode_multiplexed",
    "encode_text",
]
