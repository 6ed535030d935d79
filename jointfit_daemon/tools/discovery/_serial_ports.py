"""Serial ports of this host, from sysfs and ``/dev/serial``.

Invariant: no port is opened. Opening a port would reset some boards and could disturb other
programs.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from jointfit_daemon.tools.discovery._sysfs import read_attribute, read_number

_BUILT_IN = ("port", "serial8250")
"""Kernel names of the drivers for ports on the mainboard."""
_USB_ID = 16
"""Number base of vendor and product ids in sysfs."""


@dataclass(frozen=True, slots=True)
class SerialPortInfo:
    """One serial port."""

    device: str
    """Device file, such as ``/dev/ttyUSB0``; it can change when devices are connected."""
    by_id: str | None = None
    """Link that always refers to the same adapter: ``/dev/serial/by-id/…``."""
    by_path: str | None = None
    """Link that always refers to the same USB socket: ``/dev/serial/by-path/…``."""
    vendor_id: int | None = None
    product_id: int | None = None
    manufacturer: str | None = None
    product: str | None = None
    serial_number: str | None = None
    driver: str | None = None
    """Kernel driver, such as ``ftdi_sio`` or ``cdc_acm``."""
    latency_timer_ms: int | None = None
    """Time for which an FTDI adapter collects bytes before it sends them, ms; None for other
    adapters."""

    @property
    def path(self) -> str:
        """Path for rig.toml: a link to the adapter or socket, or else the device file."""
        return self.by_id or self.by_path or self.device

    @property
    def description(self) -> str:
        """Manufacturer, product and USB ids; without USB, the name of the kernel driver.

        The driver of a port on the mainboard is named ``built-in port``.
        """
        words = [word for word in (self.manufacturer, self.product) if word]
        if self.vendor_id is not None and self.product_id is not None:
            words.append(f"({self.vendor_id:04x}:{self.product_id:04x})")
        # The kernel names the driver of a port on the mainboard "port" or "serial8250".
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
        # Consoles and pseudo-terminals have no device. A port of type 0 (PORT_UNKNOWN) is only
        # a reserved device name, without hardware.
        if not (tty / "device").exists() or read_number(tty / "type") == 0:
            continue
        hardware = (tty / "device").resolve()
        # Find the USB device that contains the port; the result is None for other buses.
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
    """Return the links in ``/dev/serial/KIND``, by the name of the device file."""
    folder = root / "dev/serial" / kind
    links = sorted(folder.glob("*")) if folder.is_dir() else []
    return {link.readlink().name: f"/dev/serial/{kind}/{link.name}" for link in links}
