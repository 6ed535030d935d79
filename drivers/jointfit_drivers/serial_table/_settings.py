"""The ``[[imu]]`` table that describes the frames or lines of a serial device."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, field_validator
from typing_extensions import override

from jointfit_daemon.driver import Settings
from jointfit_drivers.serial_imu import SerialImuSettings
from jointfit_drivers.table_samples import (
    ChecksumSettings,
    FieldFaultError,
    FieldSettings,
    SampleForm,
    TableForm,
    TableImuSettings,
    binary_place,
    check_hexadecimal,
    orientation_faults,
    overlap_faults,
    parts_of,
    place_fields,
    sample_form,
)
from jointfit_protocols.table import (
    LONGEST_FRAME,
    SLOTS,
    FrameFormat,
    LineFormat,
    TableField,
    parse_type,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_protocols.table import Quantity

_MOST_COLUMNS = 256
_BITS = 10
"""Number of bits of one byte on the line (8N1)."""


class SerialFieldSettings(FieldSettings):
    """One quantity of a frame or line, or some of its components."""

    column: int | None = Field(
        None, ge=1, le=_MOST_COLUMNS, description="for text lines: first column, from 1"
    )


Parts = Annotated[tuple[SerialFieldSettings, ...], parts_of(SerialFieldSettings)]


class SerialFields(Settings):
    """Quantities of a frame or line."""

    quaternion: Parts = Field((), description="orientation")
    rate: Parts = Field((), description="angular rate, sensor axes")
    acceleration: Parts = Field((), description="specific force, sensor axes; upwards at rest")
    magnetic: Parts = Field((), description="magnetic field, sensor axes, any unit")
    time: Parts = Field((), description="device time of the measurement")
    counter: Parts = Field((), description="number of the sample")
    valid: Parts = Field(
        (), description="status bits; samples that they mark as invalid are dropped"
    )


class NumberSettings(Settings):
    """An integer in the frame."""

    offset: int = Field(
        ge=0, lt=LONGEST_FRAME, description="first byte of the number in the frame, from 0"
    )
    type: str = Field("u8", description="u8, u16 or another integer", examples=["u16"])
    byte_order: Literal["little", "big"] | None = Field(
        None, description="default: `byte_order` of the table"
    )

    def place(self, byte_order: Literal["little", "big"]) -> TableField | None:
        """Return the position of the number; None if its type is not an integer."""
        parsed = parse_type(self.type)
        if parsed is None or parsed[0] == "f":
            return None
        return TableField(self.offset, *parsed, self.byte_order or byte_order)


class LengthSettings(NumberSettings):
    """Field of the frame that contains the length of the frame."""

    adds: int = Field(0, description="size of the frame minus the value of this field, bytes")
    longest: int = Field(
        LONGEST_FRAME, ge=4, le=LONGEST_FRAME, description="size of the largest frame, bytes"
    )


class MessageSettings(NumberSettings):
    """Field of the frame that contains the type of the frame."""

    equals: int = Field(
        description="value of the type in frames with measurements; other frames are skipped"
    )


class FrameSettings(Settings):
    """Binary frames."""

    sync: str = Field(description="first bytes of every frame, hexadecimal", examples=["AA 55"])
    length: int | None = Field(
        None, ge=2, le=LONGEST_FRAME, description="size of every frame, bytes"
    )
    length_field: LengthSettings | None = Field(
        None, description="field of the frame that contains its length, instead of `length`"
    )
    checksum: ChecksumSettings | None = Field(
        None, description="checksum behind the fields; default: none"
    )
    end: str = Field("", description="last bytes of every frame, hexadecimal")
    message: MessageSettings | None = Field(
        None, description="type of the frame, for devices that send several types"
    )

    @field_validator("sync", "end")
    @classmethod
    def _hexadecimal(cls, text: str) -> str:
        return check_hexadecimal(text)

    @field_validator("sync")
    @classmethod
    def _not_empty(cls, text: str) -> str:
        if not text.strip():
            raise ValueError('must not be empty: expected the first bytes, such as "AA 55"')
        return text


class TextSettings(Settings):
    """Text lines: one sample per line."""

    separator: str = Field(
        ",", max_length=4, description='separator of columns; "" for blanks and tabs'
    )
    prefix: str = Field("", description="first characters of every line with measurements")
    columns: int | None = Field(
        None, ge=1, le=_MOST_COLUMNS, description="number of columns; default: not checked"
    )
    checksum: ChecksumSettings | None = Field(
        None, description="checksum after *, hexadecimal, as in NMEA 0183; default: none"
    )


class SerialTableSettings(SerialImuSettings, TableImuSettings):
    """One IMU on a serial port whose frames or lines this table describes."""

    frame: FrameSettings | None = Field(None, description="binary frames; either this or `text`")
    text: TextSettings | None = Field(None, description="text lines; either this or `frame`")
    fields: SerialFields = Field(description="place, scale and unit of each quantity")

    @property
    @override
    def serial_bits_per_s(self) -> float | None:
        if self.line_baud is None or self.frame is None or self.frame.length is None:
            return None
        return self.rate_hz * _BITS * self.frame.length

    @override
    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Yield the keys that do not fit together, each with its fault."""
        if (self.frame is None) == (self.text is None):
            if self.frame is None:
                yield "frame", "missing: add a `frame` table (binary) or a `text` table (lines)"
            else:
                yield "text", "expected either `frame` or `text`: remove one"
            return
        if not _is_readable(self):
            return  # already reported; no positions are known
        form = self.places()
        yield from form.faults
        if self.frame is not None:
            yield from self._frame_faults(self.frame, form)
        elif self.text is not None:
            yield from self._line_faults(self.text, form)
        if not form.faults:
            yield from orientation_faults(form, self, timed=True)

    def places(self) -> TableForm:
        """Return the position of every number in the frame or line."""
        quantities: Any = dict(self.fields)
        return place_fields(quantities, self._place_part)

    def sample_form(self) -> SampleForm:
        """Return the meaning of the numbers in the frame or line."""
        return sample_form(self.places(), self, is_text=self.text is not None)

    def wire_format(self) -> FrameFormat | LineFormat:
        """Return the layout of the frames or lines for the codec."""
        fields = self.places().fields
        if self.frame is None:
            text = self.text or TextSettings()
            checksum = text.checksum
            return LineFormat(
                {slot: place.offset for slot, place in fields.items()},
                text.separator.encode(),
                text.prefix.encode(),
                text.columns,
                None if checksum is None else checksum.checksum("big"),
            )

        frame, order = self.frame, self.byte_order
        by_field = frame.length_field
        length = by_field.place(order) if by_field is not None else frame.length
        message = frame.message
        selects = None if message is None else message.place(order)
        return FrameFormat(
            bytes.fromhex(frame.sync),
            fields,
            length or 0,
            0 if by_field is None else by_field.adds,
            LONGEST_FRAME if by_field is None else by_field.longest,
            None if frame.checksum is None else frame.checksum.checksum(order),
            bytes.fromhex(frame.end),
            None if selects is None or message is None else (selects, message.equals),
        )

    def _place_part(self, name: Quantity, part: FieldSettings, count: int) -> list[TableField]:
        """Return the positions of `count` components; in text lines, the offset is the column."""
        del name
        column = getattr(part, "column", None)
        if self.text is None:
            if column is not None:
                raise FieldFaultError("column", "is for text lines: give `offset` and `type`")
            return binary_place(part, count, self.byte_order)

        for key in ("offset", "type", "byte_order"):
            if getattr(part, key) is not None:
                raise FieldFaultError(key, "is for binary frames: give `column`")
        if column is None:
            raise FieldFaultError("column", "missing: expected its first column, from 1")
        return [TableField(column - 1 + at, "f", 64) for at in range(count)]

    def _line_faults(self, text: TextSettings, form: TableForm) -> Iterator[tuple[str, str]]:
        users: dict[int, str] = {}
        names = {slot: name for name in form.quantities for slot in SLOTS[name]}
        for slot, place in sorted(form.fields.items()):
            name = names[slot]
            if text.columns is not None and place.offset >= text.columns:
                found = f"needs column {place.offset + 1}, but a line has {text.columns}"
                yield f"fields.{name}.column", f"{found}: correct it, or text.columns"
                break
            owner = users.setdefault(place.offset, name)
            if owner != name:
                found = f"shares column {place.offset + 1} with fields.{owner}"
                yield f"fields.{name}.column", f"{found}: correct one of them"
                break
        if text.checksum is not None:
            yield from ((f"text.checksum.{key}", fault) for key, fault in text.checksum.faults())

    def _frame_faults(self, frame: FrameSettings, form: TableForm) -> Iterator[tuple[str, str]]:
        if (frame.length is None) == (frame.length_field is None):
            yield "frame.length", "expected either `length` or `length_field`"
            return
        others: dict[str, TableField] = {
            "frame.sync": TableField(0, "u", 8 * len(bytes.fromhex(frame.sync)))
        }
        for key, number in (("length_field", frame.length_field), ("message", frame.message)):
            if number is None:
                continue
            place = number.place(self.byte_order)
            if place is None:
                yield (
                    f"frame.{key}.type",
                    f"{number.type!r} is no integer: expected u1 to u64 or i2 to i64",
                )
                return
            others[f"frame.{key}"] = place

        width = 0
        if frame.checksum is not None:
            yield from ((f"frame.checksum.{key}", text) for key, text in frame.checksum.faults())
            width = frame.checksum.checksum(self.byte_order).width
        sizes = {}
        if frame.length is not None:
            sizes[0] = frame.length - width - len(bytes.fromhex(frame.end))
            for key, place in others.items():
                if place.end > sizes[0]:
                    yield key, f"lies beyond the frame of {frame.length} bytes"
        yield from overlap_faults(form, others, sizes)


def _is_readable(settings: Any) -> bool:
    """Return whether all keys that define field positions are valid; keys with faults are None."""
    fields, frame, text = settings.fields, settings.frame, settings.text
    if fields is None or settings.byte_order is None or settings.rate_hz is None:
        return False
    if any(parts is None or None in parts for _, parts in fields):
        return False
    if frame is not None and None in (frame.sync, frame.end):
        return False
    numbers = [] if frame is None else [frame.length_field, frame.message]
    if any(number is not None and None in (number.type, number.offset) for number in numbers):
        return False
    checksum = frame.checksum if frame is not None else text.checksum if text is not None else None
    return checksum is None or checksum.kind is not None
