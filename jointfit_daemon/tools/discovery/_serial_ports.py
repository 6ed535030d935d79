"""Serial ports of this host, from sysfs and ``/dev/serial``.

Invariant: no port is opened. Opening a port resets some boards and takes the port from other
programs.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from jointfit_daemon.tools.discovery._sysfs import read_attribute, read_number

_BUILT_IN = ("port", "serial8250")
"""Drivers of the ports of a mainboard."""
_USB_ID = 16
"""Base of vendor and product ids."""


@dataclass(frozen=True, slots=True)
class SerialPortInfo:
    """One serial port."""

    device: str
    """Device file, such as ``/dev/ttyUSB0``; it may change when devices are plugged in."""
    by_id: str | None = None
    """Link that follows the adapter: ``/dev/serial/by-id/…``."""
    by_path: str | None = None
    """Link that follows the socket: ``/dev/serial/by-path/…``."""
    vendor_id: int | None = None
    product_id: int | None = None
    manufacturer: str | None = None
    product: str | None = None
    serial_number: str | None = None
    driver: str | None = None
    """Driver of the kernel, such as ``ftdi_sio`` or ``cdc_acm``."""
    latency_timer_ms: int | None = None
    """Delay by which an FTDI adapter collects bytes, ms; None for other adapters."""

    @property
    def path(self) -> str:
        """Path for rig.toml: the most stable of device file and links."""
        return self.by_id or self.by_path or self.device

    @property
    def description(self) -> str:
        """Maker, product and USB ids; the name of the driver for a port without them."""
        words = [word for word in (self.manufacturer, self.product) if word]
        if self.vendor_id is not None and self.product_id is not None:
            words.append(f"({self.vendor_id:04x}:{self.product_id:04x})")
        # The kernel names the driver of the ports of a mainboard "port" or "serial8250".
        driver = "built-in port" if self.driver in _BUILT_IN else self.driver
        return " ".join(words) or driver or ""


def find_serial_ports(root: Path = Path("/")) -> list[SerialPortInfo]:
    """Return the serial ports of this host, ordered by device file.

    Parameters
    ----------
    root
        Folder that contains ``sys`` and ``dev``.
    """
    by_id, by_path = _links(root, "by-id"), _links(root, "by-path")
    found = []
    for tty in sorted((root / "sys/class/tty").glob("*")):
        # Consoles and pseudo-terminals have no device. For type 0, PORT_UNKNOWN, the kernel
        # reserves the name without hardware.
        if not (tty / "device").exists() or read_number(tty / "type") == 0:
            continue
        hardware = (tty / "device").resolve()
        # Find the USB device that contains the port; None for other buses.
        usb = next((up for up in (hardware, *hardware.parents) if (up / "idVendor").exists()), None)
        driver = hardware / "driver"
        found.append(
            SerialPortInfo(
                device=f"/dev/{tty.name}",
                by_id=by_id.get(tty.name),
                by_path=by_path.get(tty.name),
                vendor_id=None if usb is None else read_number(usb / "idVendor", _USB_ID),
                product_id=None if usb is None else read_number(usb / "idProduct", _USB_ID),
                manufacturer=None if usb is None else read_attribute(usb / "manufacturer"),
                product=None if usb is None else read_attribute(usb / "product"),
                serial_number=None if usb is None else read_attribute(usb / "serial"),
                driver=driver.resolve().name if driver.exists() else None,
                latency_timer_ms=read_number(hardware / "latency_timer"),
            )
        )
    return found


def _links(root: Path, kind: str) -> dict[str, str]:
    """Return the links of ``/dev/serial/KIND`` by the name of the device file."""
    folder = root / "dev/serial" / kind
    links = sorted(folder.glob("*")) if folder.is_dir() else []
    return {link.readlink().name: f"/dev/serial/{kind}/{link.name}" for link in links}
