"""Folders that imitate sysfs, procfs and /dev of a gateway, for hardware that a test cannot use."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

FTDI_LINK = "usb-FTDI_FT232R_USB_UART_A50285BI-if00-port0"


def write(path: Path, text: str | int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"{text}\n")


def link(path: Path, target: Path | str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(target)


def add_port(
    root: Path,
    name: str,
    driver: str,
    *,
    vendor: str = "0403",
    product: str = "6001",
    latency_ms: int | None = None,
    by_id: str | None = None,
    number: int = 0,
) -> None:
    """Add a USB adapter as in sysfs: the path contains USB device, interface and port."""
    usb = root / f"sys/devices/pci0000:00/usb1/1-{number + 1}"
    port = usb / f"1-{number + 1}:1.0" / name
    write(usb / "idVendor", vendor)
    write(usb / "idProduct", product)
    write(usb / "manufacturer", "Maker")
    write(usb / "product", f"Adapter {number}")
    write(usb / "serial", f"A{number}")
    write(port / "tty" / name / "dev", f"188:{number}")
    (root / "sys/bus/drivers" / driver).mkdir(parents=True, exist_ok=True)
    link(port / "driver", root / "sys/bus/drivers" / driver)
    if latency_ms is not None:
        write(port / "latency_timer", latency_ms)
    link(port / "tty" / name / "device", port)
    link(root / "sys/class/tty" / name, port / "tty" / name)
    write(root / "dev" / name, "")
    if by_id is not None:
        link(root / "dev/serial/by-id" / by_id, f"../../{name}")
        link(root / f"dev/serial/by-path/pci-usb-{number}", f"../../{name}")


def add_can(root: Path, name: str, *, up: bool = True, driver: str | None = "gs_usb") -> None:
    """Add a CAN interface; without `driver`, the interface is virtual."""
    folder = root / "sys/class/net" / name
    write(folder / "type", 280)
    write(folder / "flags", "0x40041" if up else "0x40080")
    write(folder / "operstate", "up" if up else "down")
    if driver is not None:
        (root / "sys/bus/drivers" / driver).mkdir(parents=True, exist_ok=True)
        (folder / "device").mkdir()
        link(folder / "device/driver", root / "sys/bus/drivers" / driver)
