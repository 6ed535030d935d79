"""Wire format of VectorNav over UART or USB: binary outputs and ASCII messages in one stream."""

from jointfit_protocols.vectornav._framing import (
    MAX_MESSAGE,
    UNKNOWN_HEADER,
    BinaryPacket,
    VectorNavCodec,
    VectorNavMessage,
    encode_binary,
)
from jointfit_protocols.vectornav._layout import BinaryLayout, Field, Fields
from jointfit_protocols.vectornav._text import TextMessage, encode_text, error_text

__all__ = [
    "MAX_MESSAGE",
    "UNKNOWN_HEADER",
    "BinaryLayout",
    "BinaryPacket",
    "Field",
    "Fields",
    "TextMessage",
    "VectorNavCodec",
    "VectorNavMessage",
    "encode_binary",
    "encode_text",
    "error_text",
]
