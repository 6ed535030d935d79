"""Faults in a ``[can.NAME]`` table that python-can would report only when it opens the bus.

The permitted keys of an interface are the parameters in the signature and in the docstrings of
python-can's class for this interface.
"""

from __future__ import annotations

import logging
import re
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from ctypes import CDLL
from functools import cache
from importlib import import_module, invalidate_caches
from importlib.util import find_spec
from inspect import getdoc, signature
from io import StringIO
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any

import can

from jointfit_daemon.driver import (
    FASTEST_BAUD,
    SLOWEST_BAUD,
    CanBusSettings,
    host_fault,
)
from jointfit_daemon.nearest_name import nearest_name, unknown_name

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

_WINDOWS = frozenset({"etas", "iscan", "ixxat", "nican", "nixnet", "systec", "usb2can", "vector"})
"""Interfaces of python-can whose vendor libraries exist only for Windows."""
_PACKAGES = {"neovi": "ics", "cantact": "cantact", "canalystii": "canalystii", "gs_usb": "usb"}
"""Python packages that python-can imports when a bus is opened, by interface."""
_LIBRARIES = {"pcan": "libpcanbasic.so", "kvaser": "libcanlib.so", "neousys": "libwdt_dio.so"}
"""Libraries of vendors that python-can loads when a bus is opened, by interface."""
_INSTEAD = 'set interface = "socketcan", or "slcan" for a serial adapter'
_INTERNAL = frozenset({"self", "can_filters", "timing", "kwargs", "msg", "message"})
"""Parameters of python-can that a table cannot contain, or that do not affect the opening of a
bus."""
_DOCUMENTED = re.compile(r":param (?:[\w.\[\]]+ )?(\w+):")
_SPEEDS = ("baudrate", "ttyBaudrate")
"""Names that python-can uses for the speed of a serial port."""
_RANGES = {
    "port": (1, 65_535),
    "hop_limit": (0, 255),
    "timeout": (0, 3600),
    "poll_interval": (0, 3600),
    "rx_queue_size": (0, 1 << 24),
    **dict.fromkeys(_SPEEDS, (SLOWEST_BAUD, FASTEST_BAUD)),
}
"""Smallest and largest value of keys that python-can does not check itself."""
_NUMBERS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}


def bus_faults(settings: CanBusSettings) -> dict[str, str]:
    """Return the faults of a table that prevent opening its bus on this host, by key.

    No device is opened. The module of the interface is imported, because only the import shows
    whether the vendor's library is installed.
    """
    kind = settings.interface
    if kind == "slcan":
        return _unknown_keys(settings, ())
    if kind not in can.VALID_INTERFACES:
        known = sorted({*can.VALID_INTERFACES, "slcan"})
        return {"interface": unknown_name("CAN interface", kind, known)}
    if kind in _WINDOWS:
        return {"interface": f"CAN interface {kind!r} exists on Windows only: {_INSTEAD}"}

    backend = _load_backend(kind)
    if isinstance(backend, str):
        return {"interface": backend}
    parameters = _parameters(backend)
    given = {"channel", *(settings.model_extra or {})}
    missing = {
        name: f"missing: CAN interface {kind!r} needs {name}: add it to this table"
        for name, key in signature(backend).parameters.items()
        if key.default is key.empty and key.kind is key.POSITIONAL_OR_KEYWORD and name not in given
    }
    return (
        missing
        | _unknown_keys(settings, parameters)
        | _wrong_values(settings, parameters)
        | _wrong_choices(settings, backend)
    )


@cache
def _parameters(backend: type[can.BusABC]) -> dict[str, Any]:
    """Return the keys of an interface with the default values that python-can defines."""
    documented = " ".join(filter(None, (getdoc(backend), getdoc(backend.__init__))))
    found: dict[str, Any] = dict.fromkeys(_DOCUMENTED.findall(documented))
    for name, parameter in signature(backend).parameters.items():
        found[name] = None if parameter.default is parameter.empty else parameter.default
    return {name: default for name, default in found.items() if name not in _INTERNAL}


def _unknown_keys(settings: CanBusSettings, parameters: Collection[str]) -> dict[str, str]:
    known = [*dict.fromkeys([*CanBusSettings.model_fields, *parameters])]
    faults = {}
    for name in settings.model_extra or {}:
        if name not in known:
            near = nearest_name(name, known)
            hint = f"; did you mean {near!r}?" if near else ""
            faults[name] = (
                f"unknown key of CAN interface {settings.interface!r}; known here: "
                f"{', '.join(known)}{hint}"
            )
    return faults


def _wrong_values(settings: CanBusSettings, parameters: dict[str, Any]) -> dict[str, str]:
    """Return the faults of values that have a wrong type or are out of range, by key."""
    faults = {}
    for name, value in (settings.model_extra or {}).items():
        kind = type(parameters.get(name))
        accepted = (int, float) if kind is float else (kind,)
        if name in _RANGES:
            low, high = _RANGES[name]
            accepted = (int, float) if kind is float else (int,)
            if type(value) not in accepted or not low <= value <= high:
                faults[name] = f"expected {name} = {low} to {high}, found {value!r}"
        elif name in parameters and kind in _NUMBERS and type(value) not in accepted:
            faults[name] = f"expected {_NUMBERS[kind]}"

    speed = next((name for name in _SPEEDS if name in parameters), None)
    if speed is not None and settings.baud != CanBusSettings.model_fields["baud"].default:
        faults["baud"] = (
            f"CAN interface {settings.interface!r} does not use this key: set {speed} instead"
        )
    return faults


def _wrong_choices(settings: CanBusSettings, backend: Any) -> dict[str, str]:
    """Return the faults of values that are not among the choices of an interface, by key."""
    extra, faults = settings.model_extra or {}, {}
    if settings.interface == "udp_multicast" and not _is_multicast(settings.channel):
        faults["channel"] = "expected a multicast address, such as '239.74.163.2'"
    host = extra.get("host")
    if settings.interface == "socketcand" and host is not None:
        wrong = host_fault(host) if isinstance(host, str) else "expected an address or a name"
        if wrong is not None:
            faults["host"] = wrong
    if settings.interface == "seeedstudio":
        choices = {
            "bitrate": (settings.bitrate, backend.BITRATE),
            "frame_type": (extra.get("frame_type", "STD"), backend.FRAMETYPE),
            "operation_mode": (extra.get("operation_mode", "normal"), backend.OPERATIONMODE),
        }
        for name, (value, known) in choices.items():
            if value not in list(known):
                faults[name] = f"expected one of {', '.join(map(str, sorted(known)))}"
    return faults


def _load_backend(kind: str) -> type[can.BusABC] | str:
    """Return python-can's class for an interface, or the reason why it cannot be loaded."""
    module, name = can.interfaces.BACKENDS[kind]
    invalidate_caches()  # a library may have been installed since the last attempt
    try:
        with _silent_import():
            backend: type[can.BusABC] = getattr(import_module(module), name)
        package = _PACKAGES.get(kind)
        if package is not None and find_spec(package) is None:
            return cannot_load(kind, f"the Python package {package!r} is not installed")
        if kind in _LIBRARIES:
            CDLL(_LIBRARIES[kind])
    except Exception as error:  # noqa: BLE001 - vendors' modules may raise any exception
        return cannot_load(kind, error)
    return backend


@contextmanager
def _silent_import() -> Iterator[None]:
    """Suppress output and log lines that python-can's modules write when they are imported.

    The reported fault of the table already contains the reason.
    """
    logger, printed = logging.getLogger("can"), StringIO()
    handler, propagate = logging.NullHandler(), logger.propagate
    logger.addHandler(handler)
    logger.propagate = False
    try:
        with redirect_stdout(printed), redirect_stderr(printed):
            yield
    finally:
        logger.propagate = propagate
        logger.removeHandler(handler)


def cannot_load(kind: str, error: object) -> str:
    """Return the message for an interface whose library cannot be loaded."""
    return (
        f"CAN interface {kind!r} cannot be used here ({error}): install its library, or {_INSTEAD}"
    )


def _is_multicast(address: str) -> bool:
    try:
        return ip_address(str(address)).is_multicast
    except ValueError:
        return False
