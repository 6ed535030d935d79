"""Wire formats of LP-Research LPMS: LP-BUS on a serial line (two generations), channels on CAN."""

from jointfit_protocols.lpms._framing import (
    MAX_DATA,
    MAX_MESSAGE,
    OVERHEAD,
    LpBusCodec,
    LpBusMessage,
    encode,
)
from jointfit_protocols.lpms._quaternion_scale import COARSE, UNITS, QuaternionScale, unit_of

__all__ = [
    "COARSE",
    "MAX_DATA",
    "MAX_MESSAGE",
    "OVERHEAD",
    "UNITS",
    "LpBusCodec",
    "LpBusMessage",
    "QuaternionScale",
    "encode",
    "unit_of",
]
