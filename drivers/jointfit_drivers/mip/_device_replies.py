"""Conversion of MIP replies to events: model, firmware, settings, and refused commands."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.model import DeviceEvent
from jointfit_protocols.mip import commands
from jointfit_protocols.mip.commands import Base, CommandSet, FilterSetup, Setup
from jointfit_protocols.orientation import angles_quaternion

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_daemon.model import Decoded, Quaternion
    from jointfit_protocols.mip import MipPacket

_SMALL = 1e-4
"""Largest vector component of a quaternion that counts as no rotation. This value corresponds to a
rotation by about 0.01 degrees."""
_FORMATS = {
    Setup.FORMAT_REPLY: None,
    Setup.IMU_FORMAT_REPLY: 0x80,
    Setup.FILTER_FORMAT_REPLY: 0x82,
}
"""Data set to which each reply refers; None if the reply itself contains the data set."""


def reply_events(packet: MipPacket) -> list[Decoded]:
    """Return the events of a reply. Unknown fields and fields of unexpected size are ignored."""
    out: list[Decoded] = []
    for descriptor, data in packet.fields:
        # An unknown command is no fault, because the driver tries commands that some models lack.
        if descriptor == commands.REPLY and len(data) == commands.REPLY_BYTES:
            if data[1] not in {commands.OK, commands.UNKNOWN_COMMAND}:
                name = f"command 0x{packet.descriptor_set:02X},0x{data[0]:02X}"
                text = f"{name} refused: {commands.code_text(data[1])}"
                out.append(DeviceEvent("warning", text, {"code": data[1]}))
            continue
        out += _events_of(packet.descriptor_set, descriptor, data)
    return out


def _events_of(command_set: int, descriptor: int, data: bytes) -> Iterator[Decoded]:
    """Yield the events of one field."""
    known: dict[str, object] = {}
    if command_set == CommandSet.BASE and descriptor == Base.DEVICE_INFO_REPLY:
        info = commands.decode_info(data)
        if info is not None:
            known = {"model": info.model_name, "model_number": info.model_number}
            known |= {"serial": info.serial, "firmware": info.version, "options": info.options}
    elif command_set == CommandSet.SETUP and descriptor in _FORMATS:
        data_set = _FORMATS[Setup(descriptor)]
        prefix = data[:1] if data_set is None else b""
        outputs = commands.decode_outputs(prefix, data)
        if outputs is not None:
            number = data[0] if data_set is None else data_set
            decimations = {f"0x{one.field:02X}": one.decimation for one in outputs}
            known = {f"outputs_0x{number:02X}": decimations}
    if known:
        yield DeviceEvent(
            "info", ", ".join(f"{key} {value}" for key, value in known.items()), known
        )

    turn = _transform(command_set, descriptor, data)
    if turn is None:
        return
    stored = [round(value, 6) for value in turn]
    yield DeviceEvent("info", f"sensor_to_vehicle {stored}", {"sensor_to_vehicle": stored})
    if not max(map(abs, turn[1:])) <= _SMALL:  # also true for NaN
        text = (
            f"a sensor-to-vehicle transform is stored (w x y z = {stored}): the device sends in "
            "vehicle axes, not in the axes on its housing. Remove the transform with SensorConnect "
            "before calibration, or do not change it"
        )
        yield DeviceEvent("warning", text, {"sensor_to_vehicle": stored})


def _transform(command_set: int, descriptor: int, data: bytes) -> Quaternion | None:
    """Return the sensor-to-vehicle rotation in a reply; None if the reply contains none."""
    if (command_set, descriptor) == (CommandSet.SETUP, Setup.TRANSFORM_REPLY):
        found = commands.decode_floats(data, 4)
        return None if found is None else (found[0], found[1], found[2], found[3])

    if (command_set, descriptor) == (CommandSet.FILTER, FilterSetup.ROTATION_REPLY):
        angles = commands.decode_floats(data, 3)
        if angles is not None:
            roll, pitch, yaw = angles
            return angles_quaternion(roll, pitch, yaw)
    return None
