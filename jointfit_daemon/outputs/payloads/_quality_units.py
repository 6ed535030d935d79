"""A calibration's figures as people read them. Law: pure; no figure leaves without its unit.

The core counts in radians and nanoseconds, and tables by method carry no unit. On a topic, angles
are degrees, times milliseconds, and the key that a table hangs from names the unit of all in it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

_SHOWN = {"_rad": ("_deg", 180.0 / math.pi), "_ns": ("_ms", 1e-6)}
_TABLES = {"segments": "segments_rad", "flexion": "flexion_rad"}
"""The tables of ``holdout``: radians by segment or joint, and method."""
_DIGITS = 4


def shown(quality: Mapping[str, Any]) -> dict[str, Any]:
    """Return `quality` in the units of the MQTT contract, to four digits.

    Parameters
    ----------
    quality
        As ``Calibration.quality``: nested mappings whose keys end in ``_rad``, ``_m``, ``_s``,
        ``_ns``, or carry no unit. A unit counts for all that hangs from its key.
    """
    found = dict(quality)
    if isinstance(holdout := found.get("holdout"), Mapping):
        found["holdout"] = {_TABLES.get(key, key): value for key, value in holdout.items()}
    return _table(found, 1.0)


def _table(figures: Mapping[str, Any], factor: float) -> dict[str, Any]:
    table = {}
    for key, value in figures.items():
        for unit, (wanted, scale) in _SHOWN.items():
            if key.endswith(unit):
                table[key.removesuffix(unit) + wanted] = _figure(value, scale)
                break
        else:
            table[key] = _figure(value, factor)
    return table


def _figure(value: Any, factor: float) -> Any:
    if isinstance(value, Mapping):
        return _table(value, factor)
    if isinstance(value, list | tuple):
        return [_figure(item, factor) for item in value]
    if isinstance(value, bool) or not isinstance(value, int | float):
        return value
    if isinstance(value, int) and factor == 1.0:
        return value
    return float(f"{value * factor:.{_DIGITS}g}")
