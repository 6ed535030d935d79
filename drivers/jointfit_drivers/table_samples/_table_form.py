"""Conversion of the keys of ``fields`` to positions in frames and to the meaning of a record.

Invariant: every fault is returned with its key and remedy, and no device is opened.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from jointfit_daemon.model import TickClock
from jointfit_daemon.units import S_PER_US
from jointfit_drivers.gateway_orientation import RawSamples
from jointfit_drivers.table_samples._records import SampleForm
from jointfit_drivers.table_samples._units import UNITS
from jointfit_protocols.table import (
    COMPONENTS,
    MEASURED,
    SLOTS,
    TableField,
    overlaps,
    parse_type,
    slot_quantities,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from typing import Literal

    from jointfit_drivers.table_samples._field_settings import FieldSettings, TableImuSettings
    from jointfit_protocols.table import ByteOrder, Quantity

_WRAPS = 1 << 32
"""Number of values of the Arduino functions micros() and millis()."""
_WRAPPING = ("us", "ms")
_ALL_BITS = 64

Faults = list[tuple[str, str]]
"""Keys, each with its fault and remedy."""


class FieldFaultError(Exception):
    """The position of a field cannot be determined.

    Parameters
    ----------
    name : str
        Key inside the field, such as ``offset``.
    text : str
        Description of the fault and its remedy.
    """

    def __init__(self, name: str, text: str) -> None:
        super().__init__(text)
        self.name, self.text = name, text


@dataclass
class TableForm:
    """Positions of all numbers of a table, and the faults of the table."""

    fields: dict[int, TableField] = field(default_factory=dict)
    """Position of each slot. The scale of a position converts to SI units."""
    parts: dict[int, FieldSettings] = field(default_factory=dict)
    """Keys of the field that contains each slot."""
    faults: Faults = field(default_factory=list)

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Quantities whose position is known."""
        return slot_quantities(self.fields)


def place_fields(
    quantities: Mapping[Quantity, Sequence[FieldSettings]],
    place: Callable[[Quantity, FieldSettings, int], list[TableField]],
) -> TableForm:
    """Return the positions of all slots.

    Parameters
    ----------
    quantities
        Fields of each quantity.
    place
        Function that returns the positions of a given number of components of a field, without a
        scale or with the scale of a DBC file. It raises `FieldFaultError`.
    """
    form = TableForm()
    for name, parts in quantities.items():
        if not parts:
            continue
        letters = COMPONENTS.get(name, "n")
        for at, part in enumerate(parts):
            key = f"fields.{name}" + (f"[{at}]" if len(parts) > 1 else "")
            try:
                order = _order(name, part, letters)
                placed = [_scale_field(name, part, each) for each in place(name, part, len(order))]
            except FieldFaultError as fault:
                form.faults.append((f"{key}.{fault.name}".rstrip("."), fault.text))
                continue

            for letter, each in zip(order, placed, strict=True):
                slot = SLOTS[name][letters.index(letter)]
                if slot in form.fields:
                    form.faults.append((f"{key}.order", f"component {letter} occurs twice"))
                form.fields[slot], form.parts[slot] = each, part
        missing = [
            x for x, slot in zip(letters, SLOTS[name], strict=True) if slot not in form.fields
        ]
        if missing and not any(key.startswith(f"fields.{name}") for key, _ in form.faults):
            text = f"component {', '.join(missing)} is missing: add it to `order`"
            form.faults.append((f"fields.{name}", text))
    if not any(slot < MEASURED for slot in form.fields) and not form.faults:
        form.faults.append(("fields", "expected a quaternion, or rate and acceleration"))
    return form


def binary_place(
    part: FieldSettings, count: int, byte_order: ByteOrder, frame: int = 0
) -> list[TableField]:
    """Return the positions of `count` components of a field at its offset.

    Raises
    ------
    FieldFaultError
        Offset or type of the field is missing or wrong.
    """
    if part.offset is None:
        raise FieldFaultError("offset", "missing: expected its first byte in the frame, from 0")
    if part.type is None:
        raise FieldFaultError("type", "missing: expected a type such as i16, u32 or f32")
    parsed = parse_type(part.type)
    if parsed is None:
        text = f"{part.type!r} is no type: expected u1 to u64, i2 to i64, f16, f32 or f64"
        raise FieldFaultError("type", text)

    kind, bits = parsed
    if isinstance(part.offset, tuple):
        if len(part.offset) != count:
            text = f"{len(part.offset)} offsets for {count} components: expected one each"
            raise FieldFaultError("offset", text)
        first = [8 * offset + part.bit for offset in part.offset]
    else:
        first = [8 * part.offset + part.bit + at * bits for at in range(count)]
    order = part.byte_order or byte_order
    if kind == "f" and any(at % 8 for at in first):
        raise FieldFaultError("bit", "a float begins at a whole byte: remove `bit`")
    return [TableField(at // 8, kind, bits, order, at % 8, frame=frame) for at in first]


def overlap_faults(
    form: TableForm, others: Mapping[str, TableField], sizes: Mapping[int, int]
) -> Faults:
    """Return faults of fields that overlap each other or `others`, or exceed their frame.

    Parameters
    ----------
    form
        Positions of the fields in the table.
    others
        Parts of the frames that are not fields, by key.
    sizes
        Number of bytes for fields in each frame, if known.
    """
    named = {f"fields.{_quantity(slot)} {slot}": each for slot, each in form.fields.items()}
    named |= {f"{key} ": each for key, each in others.items()}
    found: dict[tuple[str, str], str] = {}
    for one, other in overlaps(named):
        keys = (other.partition(" ")[0], one.partition(" ")[0])
        first, last = (
            max(named[one].offset, named[other].offset),
            min(named[one].end, named[other].end),
        )
        place = f"byte {first}" if last - first <= 1 else f"bytes {first} to {last - 1}"
        key, owner = keys if keys[0].startswith("fields.") else (keys[1], keys[0])
        within = "components overlap" if key == owner else f"shares {place} with {owner}"
        found.setdefault((key, owner), f"{within}: correct offset or type")
    faults = [(key, text) for (key, _), text in found.items()]

    for slot, each in form.fields.items():
        size = sizes.get(each.frame)
        if size is not None and each.end > size:
            text = f"ends at byte {each.end - 1}, but the frame has room up to byte {size - 1}"
            fault = (f"fields.{_quantity(slot)}", f"{text}: correct offset, type or length")
            faults += [] if fault[0] in {key for key, _ in faults} else [fault]
    return faults


def sample_form(form: TableForm, settings: TableImuSettings, *, is_text: bool) -> SampleForm:
    """Return the meaning of the numbers in a record."""
    slots = tuple(sorted(form.fields))
    measured = [form.fields[slot] for slot in slots if slot < MEASURED]
    clock, per_count = _clock(form, is_text=is_text)

    (counter,), (valid,) = SLOTS["counter"], SLOTS["valid"]
    counts, mask, equals = None, -1, None
    if counter in form.fields:
        configured = form.parts[counter].modulus
        counts = configured or (None if is_text else form.fields[counter].modulus)
    if valid in form.fields:
        mask, equals = form.parts[valid].mask or -1, form.parts[valid].equals

    rate = form.parts.get(SLOTS["rate"].start)
    rate_unit = 1.0 if rate is None else UNITS["rate"].get(rate.unit or "", 1.0)

    return SampleForm(
        slots,
        tuple(each.scale for each in measured),
        tuple(each.zero for each in measured),
        settings.rate_hz,
        clock,
        per_count,
        counts,
        mask,
        equals,
        settings.world,
        settings.direction == "world_to_sensor",
        None if is_text else form.fields,
        rate_unit,
        RawSamples.maker(settings),
    )


def orientation_faults(form: TableForm, settings: TableImuSettings, *, timed: bool) -> Faults:
    """Return a fault for each missing quantity that the source of the orientation requires.

    Parameters
    ----------
    form
        Positions of the fields in the table.
    settings
        Other keys of the table.
    timed
        Whether raw measurements need device time, because the arrivals are irregular.
    """
    present = form.quantities
    if settings.orientation == "device":
        if "quaternion" in present:
            return []
        text = 'the fields have no quaternion: add it, or set orientation = "gateway"'
        return [("orientation", text)]

    needed: list[Quantity] = ["rate", "acceleration"]
    needed += ["time"] if timed else []
    needed += ["magnetic"] if settings.magnetometer else []
    return [
        (f"fields.{name}", f'missing: needed by orientation = "gateway"{_WHY.get(name, "")}')
        for name in needed
        if name not in present
    ]


_WHY = {
    "time": ", because bytes arrive irregularly: send micros() or millis() with each sample",
    "magnetic": " with magnetometer = true: add it, or remove `magnetometer`",
}


def _clock(form: TableForm, *, is_text: bool) -> tuple[TickClock | None, float | None]:
    """Return the time base, and the ticks per unit of a time that is not an integer."""
    (slot,) = SLOTS["time"]
    if slot not in form.fields:
        return None, None
    place, part = form.fields[slot], form.parts[slot]
    if is_text or place.kind == "f":
        modulus = part.modulus or (_WRAPS if is_text and part.unit in _WRAPPING else None)
        per_count = place.scale / S_PER_US
        wrap = None if modulus is None else round(modulus * per_count)
        return TickClock(1000, wrap), per_count

    modulus = part.modulus or (None if place.bits == _ALL_BITS else place.modulus)
    # The tick is expressed as an integer number of ns, or as an integer number of ticks per second,
    # whichever is nearer to the configured unit.
    tick_ns = abs(place.scale) * 1e9
    whole, rate = round(tick_ns), round(1e9 / tick_ns)
    if rate == 0 or (whole and abs(whole / tick_ns - 1) <= abs(rate * tick_ns * 1e-9 - 1)):
        return TickClock(whole, modulus), None
    return TickClock(1, modulus, rate), None


def _order(name: Quantity, part: FieldSettings, letters: str) -> str:
    """Return the components that a field contains, as letters in the order of sending."""
    if part.order is None:
        return letters
    if name not in COMPONENTS:
        raise FieldFaultError("order", "is for quaternion and vectors: remove it")
    if set(part.order) - set(letters) or len(set(part.order)) != len(part.order) or not part.order:
        text = f"{part.order!r}: expected letters of {letters!r}, each at most once"
        raise FieldFaultError("order", text)
    return part.order


def _scale_field(name: Quantity, part: FieldSettings, place: TableField) -> TableField:
    """Return the position with a scale that converts to SI units."""
    if part.scale is not None and part.divisor is not None:
        raise FieldFaultError("divisor", "expected either `scale` or `divisor`")
    owners: dict[Literal["modulus", "mask", "equals"], tuple[Quantity, ...]] = {
        "modulus": ("time", "counter"), "mask": ("valid",), "equals": ("valid",),
    }  # fmt: skip
    for key, owned in owners.items():
        if name not in owned and getattr(part, key) is not None:
            raise FieldFaultError(key, f"is for {' and '.join(owned)}: remove it")

    units = UNITS.get(name, {})
    unit = 1.0
    if part.unit is not None or name == "time":
        if part.unit is None and place.scale == 1.0:
            text = f"missing: expected the unit of one count: {', '.join(units)}"
            raise FieldFaultError("unit", text)
        if part.unit is not None and part.unit not in units:
            known = f"expected one of {', '.join(units)}" if units else "it has none: remove it"
            raise FieldFaultError("unit", f"{part.unit!r} is no unit of {name}: {known}")
        unit = units.get(part.unit or "", 1.0)
    own = part.scale if part.scale is not None else 1.0 / (part.divisor or 1.0)
    scale = place.scale * own * unit
    if scale == 0.0:
        raise FieldFaultError("scale", "must not be 0")
    return place._replace(scale=scale, zero=(place.zero * own + part.zero) * unit)


def _quantity(slot: int) -> str:
    return next(name for name, slots in SLOTS.items() if slot in slots)
