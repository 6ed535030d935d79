"""Messages that a table of rig.toml describes: frames and lines on serial ports, and CAN frames."""

from jointfit_protocols.table._can_frames import (
    CanSample,
    CanTable,
    CanTableCodec,
    Multiplexer,
    encode_can_frames,
)
from jointfit_protocols.table._checksums import WIDTHS, Checksum, ChecksumKind, compile_checksum
from jointfit_protocols.table._fields import (
    COMPONENTS,
    MEASURED,
    SLOTS,
    ByteOrder,
    FieldReader,
    Kind,
    Quantity,
    TableField,
    overlaps,
    parse_type,
    slot_quantities,
)
from jointfit_protocols.table._frames import LONGEST_FRAME, FrameCodec, FrameFormat, encode_frame
from jointfit_protocols.table._lines import LONGEST_LINE, LineCodec, LineFormat, encode_line
from jointfit_protocols.table._messages import TableItem, TableMessage

__all__ = [
    "COMPONENTS",
    "LONGEST_FRAME",
    "LONGEST_LINE",
    "MEASURED",
    "SLOTS",
    "WIDTHS",
    "ByteOrder",
    "CanSample",
    "CanTable",
    "CanTableCodec",
    "Checksum",
    "ChecksumKind",
    "FieldReader",
    "FrameCodec",
    "FrameFormat",
    "Kind",
    "LineCodec",
    "LineFormat",
    "Multiplexer",
    "Quantity",
    "TableField",
    "TableItem",
    "TableMessage",
    "compile_checksum",
    "encode_can_frames",
    "encode_frame",
    "encode_line",
    "overlaps",
    "parse_type",
    "slot_quantities",
]
