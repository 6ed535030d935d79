"""Wire format XCDI of Xsens over CAN: messages, groups, and the unit of SampleTime."""

from jointfit_protocols.xcdi._messages import (
    COUNTER_MODULUS,
    OVERFLOW,
    QUATERNION_SCALE,
    TICKS_MODULUS,
    ByteOrder,
    DataId,
    XcdiCodec,
    XcdiError,
    XcdiGroup,
    XcdiIds,
    decode,
    encode,
    id_block,
    layout,
    quaternion_counts,
)
from jointfit_protocols.xcdi._tick_unit import TICK_NS, TickUnit

__all__ = [
    "COUNTER_MODULUS",
    "OVERFLOW",
    "QUATERNION_SCALE",
    "TICKS_MODULUS",
    "TICK_NS",
    "ByteOrder",
    "DataId",
    "TickUnit",
    "XcdiCodec",
    "XcdiError",
    "XcdiGroup",
    "XcdiIds",
    "decode",
    "encode",
    "id_block",
    "layout",
    "quaternion_counts",
]
