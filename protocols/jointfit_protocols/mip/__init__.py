"""Wire format MIP of MicroStrain over UART or USB: framing, commands and data fields."""

from jointfit_protocols.mip._framing import (
    MAX_PACKET,
    MAX_PAYLOAD,
    MipCodec,
    MipField,
    MipPacket,
    encode,
)

__all__ = ["MAX_PACKET", "MAX_PAYLOAD", "MipCodec", "MipField", "MipPacket", "encode"]
