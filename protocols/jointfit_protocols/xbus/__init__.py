"""Wire format Xbus of Xsens over UART or USB: framing, configuration, MTData and MTData2."""

from jointfit_protocols.xbus._framing import (
    MASTER,
    MAX_MESSAGE,
    XbusCodec,
    XbusMessage,
    XbusMessageId,
    encode,
)
from jointfit_protocols.xbus._mtdata2_layout import MTData2Layout

__all__ = [
    "MASTER",
    "MAX_MESSAGE",
    "MTData2Layout",
    "XbusCodec",
    "XbusMessage",
    "XbusMessageId",
    "encode",
]
