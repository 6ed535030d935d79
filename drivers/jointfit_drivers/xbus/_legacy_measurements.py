"""Measurements of older devices: MTData messages, whose fields depend on two device settings.

The device reports the two settings, output mode and output settings, in its replies during the
handshake. For a capture without the handshake, rig.toml defines them. Euler angles and matrices are
converted to quaternions.

Invariant: the result depends only on the messages fed.
"""

from __future__ import annotations

from math import radians, sqrt
from typing import TYPE_CHECKING, Any

from jointfit_protocols.orientation import angles_quaternion
from jointfit_protocols.xbus import XbusMessageId
from jointfit_protocols.xbus.mtdata import (
    NED,
    MTDataLayout,
    decode_device_configuration,
    decode_output_mode,
    decode_output_settings,
)
from jointfit_protocols.xbus.mtdata2 import Item, real_id

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_protocols.orientation import Quaternion, World

_QUATERNION = int(Item.QUATERNION)


class LegacyMeasurements:
    """Decodes the fields in the MTData messages of one device.

    Parameters
    ----------
    output_mode, output_settings : int, optional
        Values from rig.toml; None if the values that the device reports are used.
    world : {"NWU", "ENU"}
        World of the device, unless its output settings select NED.
    """

    def __init__(self, output_mode: int | None, output_settings: int | None, world: World) -> None:
        self._mode, self._settings, self._world = output_mode, output_settings, world
        self._layout: MTDataLayout | None = None
        self.fault = ""
        """Reason why messages cannot be decoded; empty if they can be decoded."""
        self._update()

    @property
    def world_id(self) -> int:
        """Identifier of the MTData2 quaternion that refers to the world of the MTData messages."""
        ned = self._layout is not None and self._layout.settings & NED
        return real_id(Item.QUATERNION, world="NED" if ned else self._world)

    def reply(self, mid: int, data: bytes) -> None:
        """Process a reply of the device that contains the output mode or the output settings."""
        if mid == XbusMessageId.OUTPUT_MODE_ACK:
            self._mode = decode_output_mode(data) if data else self._mode
        elif mid == XbusMessageId.OUTPUT_SETTINGS_ACK:
            self._settings = decode_output_settings(data) if data else self._settings
        elif mid == XbusMessageId.CONFIGURATION:
            self._mode, self._settings = decode_device_configuration(data) or (
                self._mode,
                self._settings,
            )
        else:
            return
        self._update()

    def read(self, data: bytes) -> Mapping[int, Any] | None:
        """Return the values of a message by MTData2 identifiers; None if the fields do not fit."""
        if self._layout is None:
            return None
        values: dict[int, Any] | None = self._layout.read(data)
        if values is None:
            return None
        if Item.EULER_ANGLES in values:
            values[_QUATERNION] = angles_quaternion(*map(radians, values.pop(Item.EULER_ANGLES)))
        elif Item.ROTATION_MATRIX in values:
            values[_QUATERNION] = _of_matrix(values.pop(Item.ROTATION_MATRIX))
        return values

    def _update(self) -> None:
        self._layout, self.fault = None, "output mode and settings of MTData are unknown"
        if self._mode is None or self._settings is None:
            return
        try:
            self._layout, self.fault = MTDataLayout(self._mode, self._settings), ""
        except ValueError as fault:
            self.fault = str(fault)


def _of_matrix(by_columns: tuple[float, ...]) -> Quaternion:
    """Return the quaternion of a matrix given by columns; its norm is 1 only for a rotation."""
    a, d, g, b, e, h, c, f, i = by_columns
    # Shepperd (1978): the largest component is the most accurate.
    squares = (1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i)
    rows = (
        (squares[0], h - f, c - g, d - b),
        (h - f, squares[1], b + d, c + g),
        (c - g, b + d, squares[2], f + h),
        (d - b, c + g, f + h, squares[3]),
    )
    largest = max(range(4), key=squares.__getitem__)
    scale = 0.5 / sqrt(squares[largest]) if squares[largest] > 0.0 else 0.0
    w, x, y, z = (scale * value for value in rows[largest])
    return w, x, y, z
