"""Families of IMUs that a scene can create.

A new family needs one function and one entry in `IMU_FAMILIES`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from jointfit_protocols.lpms.channels import sequential_ids, tpdo_ids
from jointfit_protocols.lpms.configuration import GENERATION_3, Generation
from jointfit_protocols.mip.data import DataSet, FilterField, SharedField
from jointfit_protocols.vectornav import Field
from jointfit_protocols.vectornav.registers import BOTH_PORTS
from jointfit_protocols.witmotion import RATE_CODES
from jointfit_protocols.xbus.configuration import SyncSetting
from jointfit_protocols.xbus.mtdata import SAMPLE_COUNTER, MTDataLayout, OutputMode
from jointfit_protocols.xbus.mtdata2 import Item
from jointfit_protocols.xbus.sync_lines import IN1, Polarity, SyncFunction
from jointfit_protocols.xcdi import XcdiIds
from jointfit_protocols.ximu3 import BASE_RATE_HZ
from jointfit_simulators.devices import (
    WITH_QUATERNION,
    Bno085Device,
    Bno085DeviceOptions,
    LpmsCanDevice,
    LpmsCanDeviceOptions,
    LpmsDevice,
    LpmsDeviceOptions,
    MipDevice,
    MipDeviceOptions,
    VectorNavDevice,
    VectorNavDeviceOptions,
    WitMotionDevice,
    WitMotionDeviceOptions,
    XbusDevice,
    XbusDeviceOptions,
    XcdiDevice,
    XcdiDeviceOptions,
    XImu3Device,
    XImu3DeviceOptions,
)
from jointfit_simulators.scene._described_imus import (
    binary_frames,
    halves_of_floats,
    text_lines,
    time_and_integers,
)
from jointfit_simulators.wires import line_noise

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from jointfit_simulators.scene._streams import SceneImuDevice
    from jointfit_simulators.settings import Knobs
    from jointfit_simulators.wires import CanWire

BUS = "can0"
"""Name of the CAN bus in rig.toml and in commands."""
_EVERY_MESSAGE = 0xFFFF
"""Code of the output rate for items in every message."""
_SKIPPED_EDGES = 11
"""Number of exposures between two reported sync edges: ten edges per second at 120 Hz."""
_SYNC = (SyncSetting(SyncFunction.TRIGGER_INDICATION, IN1, Polarity.RISING, 0, 0, _SKIPPED_EDGES),)
_SYNC_TOML = (
    f'sync = [{{ function = "trigger_indication", line = "in1", skip_factor = {_SKIPPED_EDGES} }}]'
)
_ID_BLOCK = 0x100
"""Number of CAN identifiers reserved for each sensor."""
_WIDE_BLOCKS = 7
"""Maximum number of sensors for which blocks of `_ID_BLOCK` fit into the 11-bit identifiers."""
_NARROW_BLOCK = 0x40
"""Number of CAN identifiers reserved for each sensor if there are more sensors."""


@dataclass(frozen=True, slots=True)
class SensorPlace:
    """Connection of one sensor in a scene."""

    knobs: Knobs
    """Settings with error magnitudes and sample rate."""
    name: str
    """Id of the sensor."""
    number: int
    """Number of the sensor in the scene, from 1."""
    sensors: int
    """Number of sensors in the scene."""
    sync_line: bool
    """Whether a sync line is connected. The device reports the edges of the line if it can."""

    @property
    def first_can_id(self) -> int:
        """First 11-bit CAN identifier of the block that belongs to this sensor, at least 64."""
        return (_ID_BLOCK if self.sensors <= _WIDE_BLOCKS else _NARROW_BLOCK) * self.number


@dataclass(frozen=True, slots=True)
class ConnectedImu:
    """A device, with its description in rig.toml."""

    device: SceneImuDevice
    keys: list[str]
    """Lines of the device's ``[[imu]]`` table, except id, segment, driver and rate_hz."""
    label: str
    """Port of the sensor, or its bus and identifier."""


@dataclass(frozen=True, slots=True)
class UartFamily:
    """Devices of one driver, each on its own pseudo-terminal (pty)."""

    create: Callable[[SensorPlace, Path], ConnectedImu]
    """Function that returns a device; the path is a symbolic link to its pseudo-terminal."""
    driver: str = ""
    """Name of the driver in rig.toml if it differs from the name of the family."""


@dataclass(frozen=True, slots=True)
class CanFamily:
    """Devices of one driver, all on the CAN bus of the scene."""

    create: Callable[[SensorPlace, CanWire], ConnectedImu]
    """Function that returns a device on the bus."""
    driver: str = ""
    """Name of the driver in rig.toml if it differs from the name of the family."""


def _can_table(place: SensorPlace, bus: CanWire) -> ConnectedImu:
    create = time_and_integers if place.number % 4 in {1, 2} else halves_of_floats
    device, keys = create(bus, place.first_can_id, place.knobs.rate_hz)
    return ConnectedImu(device, [f'can = "{BUS}"', *keys], f"{BUS}:{place.first_can_id:#05x}")


def _lpms(place: SensorPlace, port: Path) -> ConnectedImu:
    generation: Generation = 3 if int(place.knobs.rate_hz) in GENERATION_3.rates_hz else 1
    options = LpmsDeviceOptions(generation=generation)
    device = LpmsDevice(port, options=options, wire_noise=line_noise(place.knobs, place.name))
    keys = [f'port = "{port}"', "baud = 921600", f"generation = {generation}"]
    return ConnectedImu(device, keys, str(port))


def _lpms_can(place: SensorPlace, bus: CanWire) -> ConnectedImu:
    """Return a sensor; the first sensor uses sequential mode, and all others use CANopen."""
    is_first = place.number == 1
    numbers = sequential_ids(1, spaced=True) if is_first else tpdo_ids(place.number)
    options = LpmsCanDeviceOptions(
        mode="sequential" if is_first else "canopen",
        node=place.number,
        ids=numbers,
        rate_hz=place.knobs.rate_hz,
    )
    frames = ", ".join(f"frame{k} = {number:#05x}" for k, number in enumerate(numbers, 1))
    keys = [
        f'can = "{BUS}"',
        f'mode = "{options.mode}"',
        f"ids = {{ {frames} }}",
        f'precision = "{options.precision}"',
    ]
    return ConnectedImu(LpmsCanDevice(bus, options), keys, f"{BUS}:{numbers[0]:#05x}")


def _mip(place: SensorPlace, port: Path) -> ConnectedImu:
    outputs = ((SharedField.REFERENCE_TIME, 1), (FilterField.QUATERNION, 1))
    device = MipDevice(
        port,
        options=MipDeviceOptions(
            base_rates_hz=((DataSet.FILTER, round(place.knobs.rate_hz)),),
            formats=((DataSet.FILTER, outputs),),
            streams=(DataSet.FILTER,),
        ),
        wire_noise=line_noise(place.knobs, place.name),
    )
    return ConnectedImu(device, [f'port = "{port}"', "baud = 921600"], str(port))


def _serial_table(place: SensorPlace, port: Path) -> ConnectedImu:
    create = binary_frames if place.number % 4 in {1, 2} else text_lines
    device, keys = create(port, place.knobs.rate_hz, line_noise(place.knobs, place.name))
    return ConnectedImu(device, keys, str(port))


def _bno085(place: SensorPlace, port: Path) -> ConnectedImu:
    noise = line_noise(place.knobs, place.name)
    device = Bno085Device(port, options=Bno085DeviceOptions(mode="shtp"), wire_noise=noise)
    return ConnectedImu(device, [f'port = "{port}"', "baud = 3000000"], str(port))


def _vectornav(place: SensorPlace, port: Path) -> ConnectedImu:
    imu_rate_hz = 800
    divisor = max(round(imu_rate_hz / place.knobs.rate_hz), 1)
    fields = (int(Field.TIME_STARTUP), int(Field.QUATERNION))
    options = VectorNavDeviceOptions(
        imu_rate_hz=imu_rate_hz, outputs=((BOTH_PORTS, divisor, fields),), text_output=""
    )
    noise = line_noise(place.knobs, place.name)
    device = VectorNavDevice(port, options=options, wire_noise=noise)
    return ConnectedImu(device, [f'port = "{port}"', "baud = 921600"], str(port))


def _witmotion(place: SensorPlace, port: Path) -> ConnectedImu:
    rate_hz = max((rate for rate in RATE_CODES if rate <= place.knobs.rate_hz), default=10)
    options = WitMotionDeviceOptions(content=WITH_QUATERNION, rate_hz=rate_hz)
    noise = line_noise(place.knobs, place.name)
    device = WitMotionDevice(port, options=options, wire_noise=noise)
    return ConnectedImu(device, [f'port = "{port}"', "baud = 921600"], str(port))


def _xbus(place: SensorPlace, port: Path) -> ConnectedImu:
    sync = _SYNC if place.sync_line else ()
    outputs = (
        (Item.PACKET_COUNTER, _EVERY_MESSAGE),
        (Item.SAMPLE_TIME_FINE, _EVERY_MESSAGE),
        (Item.STATUS_WORD, _EVERY_MESSAGE),
        (Item.QUATERNION, round(place.knobs.rate_hz)),
        *(((Item.TRIGGER_IN1, _EVERY_MESSAGE),) if sync else ()),
    )
    device = XbusDevice(
        port,
        options=XbusDeviceOptions(
            device_id=bytes([0x03, 0x60, 0xA1, *place.name.encode()[-1:]]),
            outputs=outputs,
            sync=sync,
        ),
        wire_noise=line_noise(place.knobs, place.name),
    )
    keys = [f'port = "{port}"', "baud = 921600", *([_SYNC_TOML] if sync else [])]
    return ConnectedImu(device, keys, str(port))


def _xbus_mtdata(place: SensorPlace, port: Path) -> ConnectedImu:
    """Return an MTi or MTx of an early generation, which sends MTData messages."""
    mode = OutputMode.CALIBRATED | OutputMode.ORIENTATION | OutputMode.STATUS
    device = XbusDevice(
        port,
        options=XbusDeviceOptions(
            device_id=bytes([0x00, 0x30, 0x0A, *place.name.encode()[-1:]]),
            legacy=MTDataLayout(mode, SAMPLE_COUNTER),
            legacy_hz=place.knobs.rate_hz,
        ),
        wire_noise=line_noise(place.knobs, place.name),
    )
    return ConnectedImu(
        device, [f'port = "{port}"', "baud = 921600", 'format = "mtdata"'], str(port)
    )


def _xcdi(place: SensorPlace, bus: CanWire) -> ConnectedImu:
    first = place.first_can_id
    ids = XcdiIds(first + 0x05, first + 0x06, first + 0x21, status_word=None, error=None)
    device = XcdiDevice(bus, XcdiDeviceOptions(ids=ids, rate_hz=place.knobs.rate_hz))
    return ConnectedImu(device, [f'can = "{BUS}"', ids_toml(ids)], f"{BUS}:{ids.quaternion:#05x}")


def _ximu3(place: SensorPlace, port: Path) -> ConnectedImu:
    stored = {
        "serial_mode": 1,
        "serial_number": f"000000{place.number:02X}",
        "ahrs_message_rate_divisor": round(BASE_RATE_HZ / place.knobs.rate_hz),
        "inertial_message_rate_divisor": 0,
        "magnetometer_message_rate_divisor": 0,
    }
    device = XImu3Device(
        port,
        options=XImu3DeviceOptions(stored),
        wire_noise=line_noise(place.knobs, place.name),
    )
    return ConnectedImu(device, [f'port = "{port}"', "baud = 921600"], str(port))


def ids_toml(ids: XcdiIds) -> str:
    """Return the line of rig.toml that contains the CAN identifiers of a sensor."""
    return (
        f"ids = {{ sample_time = {ids.sample_time:#05x}, group_counter = {ids.group_counter:#05x},"
        f" quaternion = {ids.quaternion:#05x} }}"
    )


IMU_FAMILIES: dict[str, UartFamily | CanFamily] = {
    "bno085": UartFamily(_bno085),
    "can-table": CanFamily(_can_table),
    "lpms": UartFamily(_lpms),
    "lpms-can": CanFamily(_lpms_can),
    "mip": UartFamily(_mip),
    "serial-table": UartFamily(_serial_table),
    "vectornav": UartFamily(_vectornav),
    "witmotion": UartFamily(_witmotion),
    "xbus": UartFamily(_xbus),
    "xbus-mtdata": UartFamily(_xbus_mtdata, driver="xbus"),
    "xcdi": CanFamily(_xcdi),
    "ximu3": UartFamily(_ximu3),
}
"""Families by name. The name is the name of the driver, except for variants."""
