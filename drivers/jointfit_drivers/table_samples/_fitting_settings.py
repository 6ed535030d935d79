r"""Search for settings of a table that fit the data, if the configured settings do not.

Quaternions have the norm 1, and specific forces have the norm of gravity most of the time. If byte
order or type is wrong, the norms of the raw counts vary. If only the scale is wrong, the norms are
constant, and their median determines the scale.

Invariant: the result depends only on the received numbers.
"""

from __future__ import annotations

from itertools import product
from math import isfinite, sqrt
from statistics import median
from typing import TYPE_CHECKING

from jointfit_daemon.units import STANDARD_GRAVITY
from jointfit_drivers.table_samples._units import UNITS
from jointfit_protocols.table import SLOTS, FieldReader

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from jointfit_protocols.table import Quantity, TableField

_NEAR = {"quaternion": 0.02, "acceleration": 0.3}
"""Largest relative deviation of a norm that counts as near the median. Accelerations include
motion."""
_SHARE = 0.8
"""With a correct byte order and type, at least this share of the norms is near the median."""
_DIVISORS = (
    1.0, 100.0, 256.0, 1000.0, 1024.0, 2048.0, 4096.0, 8192.0, 10_000.0, 16_384.0, 32_767.0,
    32_768.0, 100_000.0, 1_000_000.0, float(1 << 30), float((1 << 31) - 1),
)  # fmt: skip
"""Numbers of counts per unit that devices use."""
_SNAP = {"quaternion": 0.01, "acceleration": 0.12}
"""Largest relative deviation of a measured number of counts per unit from one of `_DIVISORS` at
which this divisor replaces the measured number."""
_KNOWN_SCALE = 1e-9


def fitting_keys(
    quantity: Quantity,
    fields: Mapping[int, TableField] | None,
    samples: Sequence[tuple[tuple[bytes, ...], tuple[float, ...]]],
) -> str | None:
    """Return the keys of ``fields.QUANTITY`` that fit the data, as text for rig.toml.

    Parameters
    ----------
    quantity
        Quantity to check, ``quaternion`` or ``acceleration``.
    fields
        Position of each slot of the record; None for text lines.
    samples
        Bytes of the frames of each sample, and the sample's components as sent.

    Returns
    -------
    str or None
        Text for rig.toml; None if no change of byte order, type and scale explains the data.
    """
    target = 1.0 if quantity == "quaternion" else STANDARD_GRAVITY
    if fields is None:
        typical = _typical([_norm(counts) for _, counts in samples], quantity)
        return None if typical is None else _scale_key(quantity, typical, target)

    mine = [fields[slot] for slot in SLOTS[quantity]]
    for changes, candidate in _candidates(mine):
        reads = [(field.frame, FieldReader([field]).read) for field in candidate]
        norms = [
            _norm(tuple(read(data[frame], 0)[0] for frame, read in reads)) for data, _ in samples
        ]
        typical = _typical(norms, quantity)
        if typical is None:
            continue
        keys = [f'{key} = "{value}"' for key, value in changes.items()]
        scale = mine[0].scale
        if not changes or abs(typical * scale / target - 1) > _SNAP[quantity]:
            keys.append(_scale_key(quantity, typical, target))
        return ", ".join(keys)
    return None


def _candidates(
    fields: Sequence[TableField],
) -> Iterator[tuple[dict[str, str], list[TableField]]]:
    """Yield the changed keys and the fields of each combination of type and byte order.

    The first combination is the configured one.
    """
    first = fields[0]
    kinds = dict.fromkeys((first.kind, "i", "f" if first.bits in {32, 64} else "i"))
    orders = dict.fromkeys((first.byte_order, "little", "big"))
    for kind, order in product(kinds, orders):
        changes = {"type": f"{kind}{first.bits}"} if kind != first.kind else {}
        if order != first.byte_order:
            if any(field.bit or field.bits % 8 for field in fields):
                continue  # another byte order changes the positions, too
            changes["byte_order"] = order
        yield (
            changes,
            [field._replace(kind=kind, byte_order=order) for field in fields],
        )


def _norm(counts: Sequence[float]) -> float:
    return sqrt(square) if isfinite(square := sum(c * c for c in counts)) else float("nan")


def _typical(norms: Sequence[float], quantity: Quantity) -> float | None:
    """Return the median norm if most norms are near it; None otherwise."""
    finite = [norm for norm in norms if isfinite(norm)]
    if not finite:
        return None
    middle = median(finite)
    near = _NEAR[quantity] * middle
    share = sum(abs(norm - middle) <= near for norm in finite) / len(norms)
    return middle if share >= _SHARE and middle > _KNOWN_SCALE else None


def _scale_key(quantity: Quantity, typical: float, target: float) -> str:
    """Return the key that scales a norm of `typical` counts to `target`."""
    if quantity == "quaternion":
        known = min(_DIVISORS, key=lambda each: abs(typical / each - 1))
        is_known = abs(typical / known - 1) <= _SNAP[quantity]
        return f"divisor = {known:.0f}" if is_known else f"divisor = {typical:.6g}"
    fits: list[tuple[float, bool, str]] = []
    for unit, si in UNITS["acceleration"].items():
        counts = typical * si / target
        divisor = min(_DIVISORS, key=lambda known: abs(counts / known - 1))
        error = abs(counts / divisor - 1)
        if error <= _SNAP[quantity]:
            key = f'unit = "{unit}"' + ("" if divisor == 1.0 else f", divisor = {divisor:.0f}")
            fits.append((round(error, 2), divisor != 1.0, key))
    return min(fits)[2] if fits else f'unit = "m/s2", scale = {target / typical:.3g}'
