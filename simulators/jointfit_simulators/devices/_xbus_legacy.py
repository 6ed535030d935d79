"""Messages of a simulated older Xbus device: MTData, and replies to requests about MTData."""

from __future__ import annotations

import struct
from itertools import chain
from typing import TYPE_CHECKING

from jointfit_protocols.orientation import native_of
from jointfit_protocols.xbus import XbusMessageId
from jointfit_protocols.xbus.mtdata import NED, PERIOD_HZ, MTDataLayout
from jointfit_protocols.xbus.mtdata2 import FILTER_VALID, Item
from jointfit_simulators.devices._rotations import roll_pitch_yaw_deg, rotation_rows

if TYPE_CHECKING:
    from jointfit_protocols.orientation import World
    from jointfit_protocols.xbus.mtdata2 import Value
    from jointfit_simulators.devices._inertial_signals import InertialSignals
    from jointfit_simulators.imu_device import Quaternion


def legacy_content(
    layout: MTDataLayout, world: World, counter: int, q: Quaternion, inertial: InertialSignals
) -> bytes:
    """Return the data of one MTData message.

    Parameters
    ----------
    layout : MTDataLayout
        Fields of the message.
    world : World
        World of the device if its settings do not select NED.
    counter : int
        Counter of the sample.
    q : Quaternion
        Orientation from sensor to ENU world.
    inertial : InertialSignals
        Angular rate, acceleration and magnetic field.
    """
    native = native_of(q, "NED" if layout.settings & NED else world)
    columns = zip(*rotation_rows(native), strict=True)
    values: dict[int, Value] = {
        Item.PACKET_COUNTER: counter,
        Item.STATUS_BYTE: FILTER_VALID,
        Item.QUATERNION: native,
        Item.EULER_ANGLES: roll_pitch_yaw_deg(native),
        Item.ROTATION_MATRIX: tuple(chain(*columns)),
    }

    for item in (Item.ACCELERATION, Item.RATE_OF_TURN, Item.MAGNETIC_FIELD):
        value = inertial.value(item)
        if value is not None:
            values[item] = value
    return layout.write(values)


def legacy_reply(
    layout: MTDataLayout, rate_hz: float, skip: int, mid: int
) -> tuple[int, bytes] | None:
    """Return identifier and data of the answer to a request about MTData, else None."""
    replies: dict[int, bytes] = {
        XbusMessageId.OUTPUT_MODE: struct.pack(">H", layout.mode),
        XbusMessageId.OUTPUT_SETTINGS: struct.pack(">I", layout.settings),
        XbusMessageId.PERIOD: struct.pack(">H", round(PERIOD_HZ / rate_hz)),
        XbusMessageId.OUTPUT_SKIP: struct.pack(">H", skip),
    }
    data = replies.get(mid)
    return None if data is None else (mid + 1, data)
