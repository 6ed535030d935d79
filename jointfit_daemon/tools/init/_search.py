"""Searches of the dialogue for installed drivers, ports, servers, and sensors that move.

Invariant: a device is opened only by a search that the user starts.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from jointfit_daemon.driver import ImuSettings, MocapSettings
from jointfit_daemon.files.text import parse_toml
from jointfit_daemon.tools.discovery import (
    find_can_interfaces,
    find_mocap_servers,
    find_serial_ports,
    installed_drivers,
    listen_can,
    listen_serial,
)
from jointfit_daemon.tools.init._answers import wiring_of
from jointfit_daemon.tools.init._found import (
    CanSensor,
    Found,
    FoundDevice,
    ImuDriver,
    KeyChoice,
    MocapDriver,
)
from jointfit_daemon.tools.init._movement import find_moved
from jointfit_daemon.tools.init._parsing import AnswerError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from pydantic.fields import FieldInfo

    from jointfit_daemon.driver import Driver
    from jointfit_daemon.tools.init._answers import Answers

_DIALOGUE_KEYS = {"id", "segment", "driver", "port", "can", "ids", "fields", "server"}
"""Required keys that the dialogue asks for. It also asks for required keys whose values it can
list. The dialogue does not offer a driver that has other required keys."""
_LAYOUT_KEYS = (
    "frame", "text", "ids", "extended_ids", "sequence", "dbc", "fields", "byte_order", "world",
    "direction", "orientation", "magnetometer",
)  # fmt: skip
"""Keys of ``[[imu]]`` that a layout file may contain."""
_CONNECTION_KEYS = {"driver", "can", "ids"}
"""Keys of ``[[imu]]`` that locate a sensor on CAN."""
_PROPOSED_FIRST = ("xbus", "xcdi", "natnet")
"""Drivers at the start of the offered list. The other drivers follow in alphabetical order."""
LISTEN_S = 1.0
"""Time to receive at each speed of a serial port, s."""
SERVER_WAIT_S = 1.0
"""Time to wait for motion-capture servers, s."""


def drivers_found() -> Found:
    """Return the installed drivers whose required keys the dialogue can ask for."""
    imu, mocap = [], []
    known = sorted(installed_drivers(), key=lambda each: each[0] not in _PROPOSED_FIRST)
    for name, driver in known:
        fields: Mapping[str, FieldInfo] = driver.Settings.model_fields
        required = {key for key, field in fields.items() if field.is_required()}
        choices = tuple(
            KeyChoice(key, get_args(field.annotation), str(field.description or ""))
            for key, field in fields.items()
            if field.is_required() and get_origin(field.annotation) is Literal
        )
        if not required <= _DIALOGUE_KEYS | {choice.key for choice in choices}:
            continue
        if issubclass(driver.Settings, ImuSettings) and required & {"port", "can"}:
            about = replace(_imu_driver(name, fields), text=_devices_of(driver), choices=choices)
            about = replace(about, needs_layout="fields" in required)
            if "ids" in required and not about.needs_layout:  # identifiers have no default
                about = _with_identifiers(about, driver, fields)
                if not about.ids:
                    continue
            imu.append(about)
        elif issubclass(driver.Settings, MocapSettings) and "server" in fields:
            key = "command_port" if "command_port" in fields else "port"
            port = fields[key].default if key in fields else None
            text = _devices_of(driver)
            mocap.append(MocapDriver(name, port, fields["up_axis"].default, key, text))
    return Found(imu_drivers=tuple(imu), mocap_drivers=tuple(mocap))


_ARTICLES = ("One ", "The ``[mocap]`` table for ")
"""First words of the docstrings of driver settings. The names of the devices follow them."""


def _devices_of(driver: type[Driver]) -> str:
    """Return the devices that a driver reads, from the docstring of its settings."""
    text = (driver.Settings.__doc__ or "").strip().partition("\n")[0].rstrip(".")
    for article in _ARTICLES:
        text = text.removeprefix(article)
    return text


def _imu_driver(name: str, fields: Mapping[str, FieldInfo]) -> ImuDriver:
    baud = fields["baud"].default if "baud" in fields and "port" in fields else None
    ids: dict[str, int] = {}
    table = getattr(fields.get("ids"), "annotation", None)
    for key, field in getattr(table, "model_fields", {}).items():
        if isinstance(field.default, int):
            ids[key] = field.default
    return ImuDriver(name, "serial" if "port" in fields else "can", baud, ids)


def _with_identifiers(
    about: ImuDriver, driver: type[Driver], fields: Mapping[str, FieldInfo]
) -> ImuDriver:
    """Return `about` with the sensors that the driver can recognize on a CAN bus.

    The driver proposes sensors for a simulated bus on which every 11-bit identifier was received.
    """
    names = tuple(getattr(fields["ids"].annotation, "model_fields", ()))
    propose = getattr(driver, "candidate_tables", None)
    if not names or propose is None:
        return about
    possible = []
    used: dict[str, set[int]] = {}
    for table in propose({(number, False): _CAN_BYTES for number in range(_STANDARD_IDS)}):
        sensor = _can_sensor(about.name, table, names)
        taken = used.setdefault(str(sensor.settings), set())
        if taken.isdisjoint(sensor.ids):
            taken.update(sensor.ids)
            possible.append(sensor)
    first = dict(zip(names, possible[0].ids, strict=True)) if possible else {}
    return replace(about, ids=first, possible=tuple(possible))


_CAN_BYTES, _STANDARD_IDS = 8, 0x800
"""Number of data bytes of a full frame, and number of 11-bit identifiers."""


def _can_sensor(driver: str, table: Mapping[str, Any], names: Sequence[str]) -> CanSensor:
    """Return the sensor in a driver table; its identifiers have the order of `names`."""
    others = {key: value for key, value in table.items() if key != "ids"}
    return CanSensor(driver, tuple(table["ids"][name] for name in names), others)


@dataclass
class DeviceSearch:
    """Searches for devices on this machine and in its networks."""

    show: Callable[[str], None]
    """Function that prints a line."""
    ports: tuple[str, ...] = ()
    """Serial ports to offer although the search does not find them, such as pseudo-terminals."""
    network: bool = True
    """Whether to search for motion-capture servers in the networks of this machine."""

    def start(self, servers: Sequence[FoundDevice] | None = None) -> Found:
        """Return the drivers and devices; `servers` come from an earlier search, if any."""
        known = {os.path.abspath(port): "named by --port" for port in self.ports}  # noqa: PTH100 - keeps links
        known = {**known, **{info.path: info.description for info in find_serial_ports()}}
        interfaces = [
            FoundDevice(each.name, f"CAN interface, {'up' if each.up else 'down'}")
            for each in find_can_interfaces()
        ]
        found = self._servers() if servers is None else [(each, "") for each in servers]
        return replace(
            drivers_found(),
            ports=tuple(FoundDevice(path, text) for path, text in known.items()),
            interfaces=tuple(interfaces),
            servers=tuple(device for device, _ in found),
            server_drivers={device.address: driver for device, driver in found if driver},
        )

    def refresh(self, found: Found) -> Found:
        """Return `found` with the ports and interfaces that are now present."""
        fresh = self.start(found.servers)
        return replace(found, ports=fresh.ports, interfaces=fresh.interfaces)

    def is_present(self, found: Found, address: str) -> bool:
        """Return whether a device file or a CAN interface exists."""
        return address in found.addresses or ("/" in address and os.path.exists(address))  # noqa: PTH110 - NUL returns False

    def _servers(self) -> list[tuple[FoundDevice, str]]:
        """Return the motion-capture servers in the networks, each with its driver."""
        if not self.network:
            return []
        try:
            servers = asyncio.run(find_mocap_servers(broadcast=True, wait_s=SERVER_WAIT_S))
        except OSError:
            return []  # without a network nothing is found
        usual = {driver.name: driver.port for driver in drivers_found().mocap_drivers}
        found = []
        for server in servers:
            is_usual = server.port == usual.get(server.driver)
            address = server.server if is_usual else f"{server.server}:{server.port}"
            text = f"{server.application} {server.version}, {server.protocol}"
            found.append((FoundDevice(address, text), server.driver))
        return found

    def recognized_driver(self, found: Found, port: str) -> tuple[Found, str]:
        """Return `found` with the driver that decodes the data of a port, and a text for the user.

        The search sends nothing to the device.

        Raises
        ------
        AnswerError
            The port cannot be opened or is silent, or no driver decodes its data.
        """
        self.show(f"  Receiving on {port} …")
        traffic = listen_serial(port, listen_s=LISTEN_S)
        if traffic.fault is not None:
            raise AnswerError(traffic.fault)
        if not any(traffic.received_bytes.values()):
            raise AnswerError(
                f"{port} is silent: check the power of the sensor, or choose a driver"
            )
        if not traffic.devices or traffic.baud is None:
            raise AnswerError(f"{port}: no driver decodes its data: choose a driver of the list")
        device = traffic.devices[0]
        known = replace(
            found,
            recognized={**found.recognized, port: device.driver},
            bauds={**found.bauds, port: traffic.baud},
        )
        return known, f"{port}: {device.driver} at {traffic.baud} baud"

    def layout(self, found: Found, path: str, driver: str) -> Found:
        """Return `found` with the frame layout from a TOML file.

        The file contains the layout keys alone, or a rig with a sensor of `driver`.

        Raises
        ------
        AnswerError
            The file cannot be read, or contains no layout keys.
        """
        file = Path(path).expanduser()
        try:
            table = parse_toml(file.read_text(encoding="utf-8"))
        except OSError as error:
            raise AnswerError(f"{path}: {error.strerror}: expected a TOML file") from error
        except (ValueError, RecursionError) as error:
            raise AnswerError(f"{path}: {error}: expected TOML in UTF-8") from error
        imus = table.get("imu", [])
        sensors = [each for each in imus if isinstance(each, dict) and each.get("driver") == driver]
        keys = sensors[0] if sensors else table
        layout = {key: value for key, value in keys.items() if key in _LAYOUT_KEYS}
        if not layout:
            raise AnswerError(
                f"{path}: found {', '.join(table) or 'nothing'}, expected `fields` and the other "
                f"keys of an [[imu]] table of {driver}"
            )
        if isinstance(layout.get("dbc"), str):
            layout["dbc"] = str(file.absolute().parent / layout["dbc"])
        return replace(found, layouts={**found.layouts, path: layout})

    def stream_names(self, found: Found, host: str, port: int) -> tuple[Found, str]:
        """Return `found` with the marker names of a server's stream, and a text for the user."""
        if not self.network:
            return found, f"{host} was not asked for its marker names, because of --no-network"
        try:
            servers = asyncio.run(
                find_mocap_servers([host], port=port or None, wait_s=SERVER_WAIT_S)
            )
        except OSError as error:
            return found, f"{host}: {error.strerror or error}: the names of markers are unknown"
        named = [server for server in servers if server.markers or server.bodies]

        if not named:
            text = f"{host} {'sent no names' if servers else 'does not answer'}"
            return found, f"{text}: check the address, or type the names of the markers"
        markers, bodies = named[0].markers, named[0].bodies
        text = f"{host}: {len(markers)} markers, {len(bodies)} rigid bodies"
        return replace(found, markers=markers, bodies=bodies), text

    def identifiers(self, found: Found, bus: str) -> Found:
        """Return `found` with the identifiers of the sensors that send on a CAN interface.

        Raises
        ------
        AnswerError
            `bus` is a serial adapter, cannot be opened, or carries no sensor.
        """
        if "/" in bus:
            raise AnswerError(
                f"{bus} is a serial adapter, which is not searched: type the identifiers that the"
                " vendor's program shows"
            )
        sensors = tuple(self._sensors_on(found, bus))
        if not sensors:
            raise AnswerError(f"{bus}: no data of a sensor were received: check power and bit rate")
        return replace(found, can_sensors={**found.can_sensors, bus: sensors})

    def _sensors_on(self, found: Found, bus: str) -> list[CanSensor]:
        """Return every sensor that sends on `bus`."""
        traffic = listen_can(bus)
        if traffic.fault is not None:
            raise AnswerError(traffic.fault)
        drivers = {driver.name: driver for driver in found.imu_drivers}
        sensors = []
        for device in traffic.devices:
            driver, ids = drivers.get(device.driver), device.settings.get("ids") or {}
            if driver is not None and driver.ids and driver.ids.keys() <= ids.keys():
                sensors.append(_can_sensor(driver.name, device.settings, tuple(driver.ids)))
        return sensors

    def moved_device(
        self, found: Found, answers: Answers, sensor: str, choices: Sequence[FoundDevice]
    ) -> tuple[Found, str]:
        """Find the device that the user turns.

        Return `found` with the speed or the identifiers of the device, and the address of the
        device.

        Raises
        ------
        AnswerError
            No device was found, several devices moved, or no device moved.
        """
        tables = self._tables(found, answers, choices)
        if not tables:
            raise AnswerError(
                "no free port and no CAN sensor was found: connect the sensor, or name its port"
                " with --port"
            )

        self.show(f"  Opening {', '.join(tables)}; hold all sensors still …")
        rate_hz = answers["sensor_rate_hz", ""]
        _, table = asyncio.run(find_moved(sensor, tables, rate_hz, self.show))

        if "port" in table:
            port = str(table["port"])
            speed = {port: table["baud"]} if "baud" in table else {}
            return replace(found, bauds={**found.bauds, **speed}), port
        bus, ids = str(table["can"]["channel"]), tuple(table["ids"].values())
        settings = {key: table[key] for key in table if key not in _CONNECTION_KEYS}
        moved = CanSensor(table["driver"], ids, settings)
        others = (each for each in found.can_sensors.get(bus, ()) if each.ids != ids)
        return replace(found, can_sensors={**found.can_sensors, bus: (moved, *others)}), bus

    def _tables(
        self, found: Found, answers: Answers, choices: Sequence[FoundDevice]
    ) -> dict[str, dict[str, Any]]:
        """Return the ``[[imu]]`` keys of every free port and of every free sensor on a CAN bus."""
        used = {value for (key, _), value in answers.items() if key == "ids"}
        serial = [driver.name for driver in found.imu_drivers if driver.wiring == "serial"]
        names = {driver.name: driver.ids for driver in found.imu_drivers}
        tables: dict[str, dict[str, Any]] = {}
        for address in (choice.address for choice in choices):
            if wiring_of(answers, address) == "serial":
                if serial:
                    name = found.recognized.get(address, serial[0])
                    tables[address] = {"driver": name, "port": address}
            elif "/" not in address:
                with contextlib.suppress(AnswerError):  # a bus that is down has no sensors
                    for sensor in self._sensors_on(found, address):
                        if sensor.ids not in used:
                            name = f"{address} {' '.join(map(hex, sensor.ids))}"
                            tables[name] = {
                                "driver": sensor.driver,
                                "can": {"interface": "socketcan", "channel": address},
                                "ids": dict(zip(names[sensor.driver], sensor.ids, strict=True)),
                                **sensor.settings,
                            }
        return tables
