"""Units of a calibration's quality on MQTT: degrees, milliseconds, and four significant digits.

The core uses radians and nanoseconds, and its tables of errors by method have keys without a unit.
Invariant: on a topic, every quantity has a unit in its own key or in the key of the table that
contains it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

_CONVERTED = {"_rad": ("_deg", 180.0 / math.pi), "_ns": ("_ms", 1e-6)}
"""Conversion by suffix of the key in the core: suffix on MQTT, and factor."""
_TABLES = {"segments": "segments_rad", "flexion": "flexion_rad"}
"""Tables in ``holdout`` with the error of each method, rad, for each segment or joint."""
_PARAMETERS = ("sensors", "regression")
"""Tables of quaternions and coefficients, which are published with all digits. With four digits,
orientations computed from them would have an error of about 0.1 degrees."""
_DIGITS = 4


def quality_payload(quality: Mapping[str, Any]) -> dict[str, Any]:
    """Return `quality` in the units of MQTT, with numbers rounded to four significant digits.

    Parameters
    ----------
    quality
        Nested mappings of ``Calibration.quality``. Keys end in ``_rad``, ``_m``, ``_s`` or ``_ns``,
        or have no unit. The unit of a key applies to all values below it.
    """
    found = dict(quality)
    if isinstance(holdout := found.get("holdout"), Mapping):
        found["holdout"] = {_TABLES.get(key, key): value for key, value in holdout.items()}
    parameters = {key: found.pop(key) for key in _PARAMETERS if key in found}
    return _convert_table(found, 1.0) | parameters


def _convert_table(values: Mapping[str, Any], factor: float) -> dict[str, Any]:
    table = {}
    for key, value in values.items():
        for unit, (wanted, scale) in _CONVERTED.items():
            if key.endswith(unit):
                table[key.removesuffix(unit) + wanted] = _convert(value, scale)
                break
        else:
            table[key] = _convert(value, factor)
    return table


def _convert(value: Any, factor: float) -> Any:
    if isinstance(value, Mapping):
        return _convert_table(value, factor)
    if isinstance(value, list | tuple):
        return [_convert(item, factor) for item in value]
    if isinstance(value, bool) or not isinstance(value, int | float):
        return value
    if isinstance(value, int) and factor == 1.0:
        return value
    return float(f"{value * factor:.{_DIGITS}g}")
