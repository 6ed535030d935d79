"""The devices of a host are found in the kernel's files; no device is opened."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.tools.discovery import (
    configured_can_channels,
    find_can_interfaces,
    find_mocap_servers,
    find_serial_ports,
)
from jointfit_simulators.devices import NatNetServer, NatNetServerOptions, RigidBodyAsset
from tests.tools.discovery.host_tree import FTDI_LINK, add_can, add_port, link, write

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence
    from pathlib import Path

BODIES = (RigidBodyAsset("Thigh", ("T1", "T2", "T3"), 1), RigidBodyAsset("Shank", ("S1",), 2))


def test_an_adapter_is_described_by_its_stable_link_ids_and_latency(tmp_path: Path) -> None:
    add_port(tmp_path, "ttyUSB0", "ftdi_sio", latency_ms=16, by_id=FTDI_LINK)
    (port,) = find_serial_ports(tmp_path)
    assert port.device == "/dev/ttyUSB0"
    assert port.path == port.by_id == f"/dev/serial/by-id/{FTDI_LINK}"
    assert port.by_path == "/dev/serial/by-path/pci-usb-0"
    assert (port.vendor_id, port.product_id, port.serial_number) == (0x0403, 0x6001, "A0")
    assert (port.driver, port.latency_timer_ms) == ("ftdi_sio", 16)
    assert port.description == "Maker Adapter 0 (0403:6001)"


def test_a_port_without_links_or_usb_is_found_by_its_device_file(tmp_path: Path) -> None:
    hardware = tmp_path / "sys/devices/platform/serial0"
    write(hardware / "uevent", "")
    link(tmp_path / "sys/class/tty/ttyAMA0/device", hardware)
    (port,) = find_serial_ports(tmp_path)
    assert (port.path, port.vendor_id, port.latency_timer_ms) == ("/dev/ttyAMA0", None, None)


def test_consoles_and_reserved_names_without_hardware_are_not_ports(tmp_path: Path) -> None:
    write(tmp_path / "sys/class/tty/tty1/dev", "4:1")  # a console
    hardware = tmp_path / "sys/devices/platform/serial8250"
    write(hardware / "uevent", "")
    write(tmp_path / "sys/class/tty/ttyS3/type", 0)  # PORT_UNKNOWN
    link(tmp_path / "sys/class/tty/ttyS3/device", hardware)
    assert find_serial_ports(tmp_path) == []


def ip_output(commands: list[Sequence[str]], **data: object) -> object:
    def run(command: Sequence[str]) -> str:
        commands.append(command)
        return json.dumps([{"linkinfo": {"info_kind": "can", "info_data": data}}])

    return run


def test_state_and_bit_rate_of_a_can_interface_come_from_ip(tmp_path: Path) -> None:
    add_can(tmp_path, "can0")
    write(tmp_path / "sys/class/net/eth0/type", 1)
    commands: list[Sequence[str]] = []
    data = {
        "state": "BUS-OFF", "bittiming": {"bitrate": 500000}, "restart_ms": 100,
        "ctrlmode": ["LISTEN-ONLY"],
    }  # fmt: skip
    (found,) = find_can_interfaces(tmp_path, ip_output(commands, **data))  # type: ignore[arg-type]
    assert commands == [["ip", "-details", "-json", "link", "show", "dev", "can0"]]
    assert (found.name, found.kind, found.up, found.driver) == ("can0", "can", True, "gs_usb")
    assert (found.state, found.bitrate, found.restart_ms) == ("BUS-OFF", 500000, 100)
    assert found.listen_only


@pytest.mark.parametrize("text", [None, "", "not JSON", "[]", "{}"])
def test_without_ip_the_state_of_an_interface_is_unknown(tmp_path: Path, text: str | None) -> None:
    add_can(tmp_path, "can0", up=False)
    add_can(tmp_path, "vcan0", driver=None)
    down, virtual = find_can_interfaces(tmp_path, lambda _: text)
    assert (down.up, down.state, down.bitrate) == (False, None, None)
    assert (virtual.kind, virtual.up) == ("vcan", True)


def test_buses_in_the_files_of_python_can_are_found(tmp_path: Path) -> None:
    write(tmp_path / "etc/can.conf", "[default]\ninterface = pcan\nchannel = PCAN_USBBUS1\n")
    write(tmp_path / ".canrc", "[lab]\nbustype = slcan\nchannel = /dev/ttyACM0\nbitrate = 500000")
    write(tmp_path / ".can", "no section")
    buses = [(bus.interface, bus.channel, bus.bitrate) for bus in
             configured_can_channels(tmp_path, tmp_path)]  # fmt: skip
    assert buses == [("pcan", "PCAN_USBBUS1", None), ("slcan", "/dev/ttyACM0", 500000)]


@pytest.fixture
async def server() -> AsyncIterator[NatNetServer]:
    made = NatNetServer(NatNetServerOptions(BODIES, bitstream=(4, 0)))
    task = asyncio.create_task(made.run())
    yield made
    task.cancel()
    await asyncio.wait([task])
    made.unplug()


async def test_a_named_server_answers_with_its_names_and_is_left(server: NatNetServer) -> None:
    """A server at a known address returns its names. The connection to it is then closed."""
    (found,) = await find_mocap_servers(["127.0.0.1"], port=server.command_port)
    assert (found.driver, found.server, found.port) == ("natnet", "127.0.0.1", server.command_port)
    assert (found.application, found.protocol) == ("Motive", "NatNet 4.0")
    assert (found.transport, found.interface) == ("unicast", "127.0.0.1")
    assert found.bodies == ("Thigh", "Shank")
    assert found.markers == ("T1", "T2", "T3", "S1")
    async with asyncio.timeout(5):
        while server.clients:
            await asyncio.sleep(0.01)


async def test_a_broadcast_finds_a_server_and_connects_to_none(server: NatNetServer) -> None:
    (found,) = await find_mocap_servers(broadcast=True, port=server.command_port, wait_s=0.3)
    assert (found.application, found.bodies) == ("Motive", ())
    assert server.clients == ()


async def test_a_host_that_does_not_answer_is_no_server(server: NatNetServer) -> None:
    server.unplug()
    hosts = ["127.0.0.1"]
    assert await find_mocap_servers(hosts, port=server.command_port, wait_s=0.1) == []


async def test_an_unknown_host_is_named() -> None:
    with pytest.raises(OSError, match=r"no-such-host\.invalid: no such host"):
        await find_mocap_servers(["no-such-host.invalid"])
