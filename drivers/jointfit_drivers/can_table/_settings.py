"""The ``[[imu]]`` table that describes the frames of a CAN device."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import AfterValidator, Field, field_validator
from typing_extensions import override

from jointfit_daemon.driver import Settings
from jointfit_drivers.can_imu import CanImuSettings
from jointfit_drivers.can_table._dbc import read_signals
from jointfit_drivers.table_samples import (
    UNITS,
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
from jointfit_protocols.can import EXTENDED_MAX, STANDARD_MAX
from jointfit_protocols.table import MEASURED, CanTable, Multiplexer, TableField

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_drivers.ports.can_bus import CanKey
    from jointfit_protocols.table import Quantity

_FRAME_BYTES = 8
_SHARE_OF_PERIOD = 0.5
"""Longest time between the first and the last frame of a sample, in nominal periods."""


def _check_first_bytes(text: str) -> str:
    if not 1 <= len(bytes.fromhex(check_hexadecimal(text))) <= _FRAME_BYTES:
        raise ValueError(f'expected 1 to {_FRAME_BYTES} bytes in hexadecimal, such as "AA 55"')
    return text


class CanFieldSettings(FieldSettings):
    """One quantity in the frames, or some of its components."""

    frame: str | None = Field(
        None,
        description="name in `ids` of the frame that contains the quantity; default: the frame "
        "that has the name of the quantity, or the only frame",
    )
    signals: tuple[str, ...] | None = Field(
        None,
        description="signals of the `dbc` file, SIGNAL or MESSAGE.SIGNAL, in the order of `order`; "
        "instead of `offset` and `type`",
    )


Parts = Annotated[tuple[CanFieldSettings, ...], parts_of(CanFieldSettings)]


class CanFields(Settings):
    """All quantities in the frames."""

    quaternion: Parts = Field((), description="orientation")
    rate: Parts = Field((), description="rate of turn, sensor axes")
    acceleration: Parts = Field((), description="specific force, sensor axes; upwards at rest")
    magnetic: Parts = Field((), description="magnetic field, sensor axes, any unit")
    time: Parts = Field((), description="device time of the measurement")
    counter: Parts = Field((), description="number of the sample")
    valid: Parts = Field(
        (), description="status bits; samples that they mark as invalid are dropped"
    )


class CanTableSettings(CanImuSettings, TableImuSettings):
    """One IMU on a CAN bus whose frames this table describes."""

    ids: dict[str, Annotated[int, Field(ge=0, le=EXTENDED_MAX)]] = Field(
        description="identifier of each frame, by a name of your choice",
        examples=[{"quaternion": 0x131}],
    )
    extended_ids: bool = Field(
        False, description="29-bit identifiers even if the numbers fit 11 bits"
    )
    starts_with: dict[str, Annotated[str, AfterValidator(_check_first_bytes)]] = Field(
        {},
        description="first data bytes, hexadecimal, of frames with the same identifier, by the "
        "names of `ids`; frames that begin with other bytes are ignored",
        examples=[{"rate": "01", "acceleration": "02"}],
    )
    sequence: tuple[str, ...] = Field(
        (),
        description="names of `ids` in the order in which the device sends the frames of a sample; "
        "default: the lowest identifier first; equal identifiers in the order of `ids`",
    )
    dbc: str | None = Field(None, description="DBC file with the `signals` of the fields")
    fields: CanFields = Field(description="place, scale and unit of each quantity")

    @field_validator("ids")
    @classmethod
    def _not_empty(cls, ids: dict[str, int]) -> dict[str, int]:
        if not ids:
            raise ValueError("must not be empty: expected a frame, such as { quaternion = 0x131 }")
        return ids

    @property
    @override
    def can_frames(self) -> tuple[tuple[int, bool], ...]:
        fields = self.places().fields.values()
        return tuple(
            (max(each.end for each in fields if each.frame == number), extended)
            for number, (_, extended) in enumerate(self.keys())
            if any(each.frame == number for each in fields)
        )

    @override
    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Yield each key that contradicts another key or the DBC file, and the reason."""
        if not self._is_readable():
            return  # the invalid keys are already reported
        faults = list(self._id_faults())
        yield from faults
        if faults:
            return
        form = self.places()
        yield from form.faults
        multiplexer_faults = self._multiplexers()[1]
        yield from multiplexer_faults
        if multiplexer_faults:
            return  # further faults would be consequences of these faults
        sizes = dict.fromkeys(range(len(self.ids)), _FRAME_BYTES)
        yield from overlap_faults(form, self._first_bytes(), sizes)
        if not form.faults or self.dbc is None:  # a faulty signal has no multiplexer
            yield from self._shared_id_faults()
        if form.faults:
            return
        unused = [
            name
            for number, name in enumerate(self.order())
            if not any(each.frame == number for each in form.fields.values())
        ]
        for name in unused:
            yield f"ids.{name}", f"no field is in this frame: give a field frame = {name!r}"
        last = len(self.ids) - 1
        if not unused and not any(
            each.frame == last for slot, each in form.fields.items() if slot < MEASURED
        ):
            text = "the last frame of a sample needs measurements: correct the order"
            yield "sequence" if self.sequence else "ids", text
        yield from orientation_faults(form, self, timed=False)

    def order(self) -> tuple[str, ...]:
        """Return the names of the frames in the order in which the device sends them."""
        return self.sequence or tuple(sorted(self.ids, key=self.ids.__getitem__))

    def keys(self) -> tuple[tuple[int, bool], ...]:
        """Return all identifiers and whether they have 29 bits, in the order of sending."""
        numbers = [self.ids[name] for name in self.order()]
        return tuple((number, self.extended_ids or number > STANDARD_MAX) for number in numbers)

    def places(self) -> TableForm:
        """Return the position of every number in the frames."""
        quantities: Any = dict(self.fields)
        return place_fields(quantities, self._place)

    def sample_form(self) -> SampleForm:
        """Return the meaning of the numbers in the frames."""
        return sample_form(self.places(), self, is_text=False)

    def can_table(self) -> CanTable:
        """Return the layout of the frames for the codec."""
        longest_ns = round(_SHARE_OF_PERIOD * 1e9 / self.rate_hz)
        return CanTable(
            self.keys(), self.places().fields, longest_ns, self.order(), self.multiplexers()
        )

    def multiplexers(self) -> dict[int, Multiplexer]:
        """Return the multiplexer of each multiplexed frame, by the frame's index in `order`."""
        return self._multiplexers()[0]

    def _place(self, name: Quantity, part: FieldSettings, count: int) -> list[TableField]:
        """Return the positions of a field, from its offset or from the DBC file."""
        signals = getattr(part, "signals", None)
        if signals is None:
            return binary_place(part, count, self.byte_order, self._frame(name, part))

        if self.dbc is None:
            raise FieldFaultError("signals", "needs a file: set `dbc`, or give `offset` and `type`")
        for key in ("offset", "type", "byte_order"):
            if getattr(part, key) is not None:
                raise FieldFaultError(key, "is in the DBC file: remove it")
        if len(signals) != count:
            text = f"{len(signals)} signals for {count} components: expected one signal for each"
            raise FieldFaultError("signals", text)
        placed = []
        for found in read_signals(self.dbc, signals):
            si = 1.0 if part.unit else UNITS.get(name, {}).get(found.unit or "", 1.0)
            place = found.place
            placed.append(
                place._replace(
                    frame=self._frame_of_signal(found.key, name, part),
                    scale=place.scale * si,
                    zero=place.zero * si,
                )
            )
        return placed

    def _frame_of_signal(self, key: CanKey, name: str, part: FieldSettings) -> int:
        """Return the index in `order` of the frame that contains a signal of the DBC file."""
        order = self.order()
        possible = [number for number, each in enumerate(self.keys()) if each == key]
        if len(possible) == 1:
            return possible[0]
        number = f"{key[0]:#x}" + (" (29 bits)" if key[1] else "")
        if not possible:
            text = f"are in the frame {number}, which is not in `ids`: add it"
            raise FieldFaultError("signals", text)
        chosen = getattr(part, "frame", None) or name
        if chosen not in order or order.index(chosen) not in possible:
            choices = ", ".join(order[each] for each in possible)
            text = f"expected one of {choices}, which have the identifier {number}"
            raise FieldFaultError("frame", text)
        return order.index(chosen)

    def _multiplexers(self) -> tuple[dict[int, Multiplexer], list[tuple[str, str]]]:
        """Return the multiplexers of `starts_with` and of the DBC file, and their faults."""
        order = self.order()
        found: dict[int, Multiplexer] = {}
        faults = []
        for name, digits in self.starts_with.items():
            if name not in order:
                faults.append(
                    (f"starts_with.{name}", f"expected a name of `ids`: {', '.join(order)}")
                )
                continue
            first = bytes.fromhex(digits)
            mask = int.from_bytes(b"\xff" * len(first), "little")
            value = int.from_bytes(first, "little")
            found[order.index(name)] = Multiplexer(mask, frozenset({value}))

        for quantity, number, multiplexer in self._multiplexed_signals():
            common = found.get(number, multiplexer) & multiplexer
            if common.values:
                found[number] = common
                continue
            text = (
                f"is not in the same frames as the rest of {order[number]!r}, because it is "
                "multiplexed: give each value of the multiplexer a frame of its own in `ids`"
            )
            if order[number] in self.starts_with:
                text += ", and correct or remove `starts_with`"
            faults.append((f"fields.{quantity}", text))
        return found, list(dict.fromkeys(faults))

    def _first_bytes(self) -> dict[str, TableField]:
        """Return the positions of the bytes of `starts_with`, by the keys in rig.toml."""
        order = self.order()
        return {
            f"starts_with.{name}": TableField(
                0, "u", 8 * len(bytes.fromhex(digits)), frame=order.index(name)
            )
            for name, digits in self.starts_with.items()
        }

    def _multiplexed_signals(self) -> Iterator[tuple[str, int, Multiplexer]]:
        """Yield quantity, frame index and multiplexer of each multiplexed signal of the file."""
        for quantity, parts in self.fields:
            for part in parts:
                if self.dbc is None or part.signals is None:
                    continue
                with suppress(FieldFaultError):  # `places` reports the fault
                    for signal in read_signals(self.dbc, part.signals):
                        if signal.multiplexer is not None:
                            number = self._frame_of_signal(signal.key, quantity, part)
                            yield quantity, number, signal.multiplexer

    def _frame(self, name: Quantity, part: FieldSettings) -> int:
        """Return the index in `order` of the frame that contains a field."""
        order = self.order()
        frame = getattr(part, "frame", None)
        if frame is None:
            if len(order) == 1:
                return 0
            if name not in order:
                text = f"missing: expected the name of its frame: {', '.join(order)}"
                raise FieldFaultError("frame", text)
            frame = name
        if frame not in order:
            text = f"{frame!r} is no frame of `ids`: expected one of {', '.join(order)}"
            raise FieldFaultError("frame", text)
        return order.index(frame)

    def _id_faults(self) -> Iterator[tuple[str, str]]:
        for name, number in self.ids.items():
            if number > STANDARD_MAX and self.extended_ids is False:
                yield (
                    "extended_ids",
                    f"ids.{name} = 0x{number:X} is above 0x{STANDARD_MAX:X}, the greatest 11-bit "
                    "identifier: correct it, or set extended_ids = true if the sensor sends 29-bit "
                    "identifiers",
                )
        if self.sequence and sorted(self.sequence) != sorted(self.ids):
            yield "sequence", f"expected each name of `ids` once: {', '.join(self.ids)}"

    def _shared_id_faults(self) -> Iterator[tuple[str, str]]:
        """Yield each frame that has the identifier of another frame but no distinguishing data."""
        order, multiplexers = self.order(), self.multiplexers()
        for at, name in enumerate(order):
            for before, owner in enumerate(order[:at]):
                if self.ids[owner] != self.ids[name]:
                    continue
                one, other = multiplexers.get(before), multiplexers.get(at)
                if one is None or other is None or not one.excludes(other):
                    text = (
                        f"0x{self.ids[name]:X} is also the identifier of {owner}: correct one of "
                        "them, or set `starts_with` to the first data bytes of both frames"
                    )
                    yield f"ids.{name}", text

    def _is_readable(self) -> bool:
        """Return whether the keys that define field positions are valid; faulty keys are None."""
        ids: Any = self.ids
        starts: Any = self.starts_with
        keys: list[Any] = [self.extended_ids, self.sequence, self.byte_order, self.rate_hz]
        fields: Any = self.fields
        if None in [ids, starts, fields, *keys] or None in [*ids.values(), *starts.values()]:
            return False
        return not any(parts is None or None in parts for _, parts in fields)
