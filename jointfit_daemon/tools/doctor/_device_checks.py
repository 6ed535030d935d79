"""Checks of the sensors on serial ports: family, speed and outputs, determined by listening.

Invariant: nothing is sent to a device.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from jointfit_daemon.device_search import Finding
from jointfit_daemon.files.text import toml_value
from jointfit_daemon.tools.discovery import LEAST_SAMPLES, listen_serial

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from jointfit_daemon.config import Source
    from jointfit_daemon.tools.discovery import DecodedDevice, SerialTraffic
    from jointfit_daemon.tools.doctor._host import Host

CHECK = "sensor"
_LISTEN_S = 1.0
"""Listening time at each line speed, s. It suffices for `LEAST_SAMPLES` samples at 5 Hz."""
_CONNECTION = {"id", "segment", "driver", "port", "baud", "transport", "silence_s"}
"""Keys of ``[[imu]]`` that do not affect decoding."""
_SILENT = (
    "silent: probably a device that waits for a command; its family can be determined only after "
    "the daemon has opened it"
)


def check_devices(host: Host, sources: Iterable[Source]) -> Iterator[Finding]:
    """Compare the data on serial ports with the configured drivers; yield the findings.

    `_serial_checks.py` reports missing ports, ports without permission, and ports in use.

    Parameters
    ----------
    host
        The host to check.
    sources
        Devices of rig.toml. Devices without a serial port are skipped.
    """
    checked = [
        source
        for source in sources
        if source.kind == "imu" and source.driver_class.wire == "stream" and _is_free(host, source)
    ]
    if not checked:
        return
    with ThreadPoolExecutor(len(checked)) as pool:
        yield from pool.map(lambda source: _check(host, source), checked)


def _is_free(host: Host, source: Source) -> bool:
    node = host.at(source.settings.port)
    if not node.is_char_device() or not host.may_open(node):
        return False
    # The simulator is one process that has the pseudo-terminal open. A running daemon is a second
    # process.
    is_pseudo = node.resolve().is_relative_to(host.at("/dev/pts"))
    return len(host.holders(node)) <= is_pseudo


def _check(host: Host, source: Source) -> Finding:
    """Return the finding about one sensor."""
    port, baud = source.settings.port, source.settings.baud
    table: dict[str, Any] = source.settings.model_dump(exclude_unset=True, exclude=_CONNECTION)
    layouts = {source.driver: [table]}
    heard = listen_serial(str(host.at(port)), listen_s=_LISTEN_S, bauds=[baud], layouts=layouts)
    if heard.fault is None and not heard.devices and heard.received_bytes.get(baud):
        heard = listen_serial(str(host.at(port)), listen_s=_LISTEN_S, layouts=layouts)
    name = f"{source.id} ({port})"
    if heard.fault is not None:
        return Finding(CHECK, name, "unknown", f"not checked: {heard.fault}")
    if not any(heard.received_bytes.values()):
        return Finding(CHECK, name, "note", _SILENT)
    return _compare(source, table, name, heard)


def _compare(  # noqa: PLR0911 - one for each finding
    source: Source, table: dict[str, Any], name: str, heard: SerialTraffic
) -> Finding:
    """Return the finding that follows from the received bytes."""
    expected = f'driver "{source.driver}" at {source.settings.baud} baud'
    if not heard.devices:
        text = f"{sum(heard.received_bytes.values())} bytes, but no driver decodes them"
        remedy = (
            'correct the port, or describe the data with driver = "serial-table"; if rig.toml '
            "has such a table, `jointfitd` logs the setting that fits the data"
        )
        return Finding(CHECK, name, "error", f"{text}, expected {expected}", remedy)

    # The configured driver may have decoded the data twice: with the settings of rig.toml, and with
    # its default settings. Prefer the settings of rig.toml.
    same = [device for device in heard.devices if device.driver == source.driver]
    own = [device for device in same if table.items() <= device.settings.items()] or same
    others = [device for device in heard.devices if device.driver != source.driver]
    found = max(own or others, key=lambda device: device.samples)
    at = f"{_model(found)} at {heard.baud} baud"
    if not own:
        remedy = (
            f'set driver = "{found.driver}" and baud = {heard.baud}, or set port to the port '
            f"of the {source.driver} device; lines to copy: jointfit probe --serial "
            f"{source.settings.port}"
        )
        text = f"the device on this port is {at}, expected {expected}"
        return Finding(CHECK, name, "error", text, remedy)
    if heard.baud != source.settings.baud:
        text = f"the device is {at}, expected {expected}"
        return Finding(CHECK, name, "error", text, f"set baud = {heard.baud}")

    said = "; ".join(found.warnings)
    proposed = [
        f"{key} = {toml_value(value)}"
        for key, value in found.settings.items()
        if key != "baud" and key not in table
    ]
    if proposed:
        return Finding(CHECK, name, "warning", f"{at}: {said}", f"set {', '.join(proposed)}")
    if found.samples < LEAST_SAMPLES:
        said = said or "the daemon configures the device when it opens the port"
        return Finding(CHECK, name, "note", f"{at} sends no orientation: {said}")
    if found.warnings:
        remedy = "correct this, then run `jointfit doctor` again"
        return Finding(CHECK, name, "warning", f"{at}: {said}", remedy)
    rate = "" if found.rate_hz is None else f", {found.rate_hz:.1f} Hz"
    return Finding(CHECK, name, "ok", f"{at}{rate}")


def _model(device: DecodedDevice) -> str:
    model = device.properties.get("model")
    return f'"{device.driver}"' + (f" ({model})" if model else "")
