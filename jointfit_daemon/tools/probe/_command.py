"""Command `jointfit probe`: lists devices, and decodes the data of named ports."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jointfit_daemon.tools.command_group import EXIT_FAILED
from jointfit_daemon.tools.completion import complete_can_interface, complete_serial_port

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.tools.discovery import (
        CanTraffic,
        FoundServer,
        Layouts,
        SerialTraffic,
    )
    from jointfit_daemon.tools.probe._probe_report import ProbeReport

_MOST_PORT = 65_535

_Serial = Annotated[
    list[str] | None,
    typer.Option(
        help="Serial port to listen on, PATH; repeatable.", autocompletion=complete_serial_port
    ),
]
_Can = Annotated[
    list[str] | None,
    typer.Option(
        help="CAN interface to listen on, NAME; repeatable.", autocompletion=complete_can_interface
    ),
]
_Mocap = Annotated[
    list[str] | None,
    typer.Option(help="Motion-capture server to ask, HOST or HOST:PORT; repeatable."),
]
_PhysicalTest = Annotated[
    str | None,
    typer.Option(
        help="Test the sensor with this id in rig.toml by three rotations; stop the daemon first."
    ),
]
_Config = Annotated[
    Path,
    typer.Option(help="rig.toml with the sensor for --physical-test, and with layouts to try."),
]
_Step = Annotated[
    float, typer.Option("--step", help="Longest time for a rotation, s.", min=2.0, max=600.0)
]


def probe(
    *,
    serial: _Serial = None,
    can: _Can = None,
    mocap: _Mocap = None,
    network: Annotated[
        bool,
        typer.Option(
            "--network", help="Search the network for motion-capture servers by one broadcast."
        ),
    ] = False,
    listen_s: Annotated[
        float,
        typer.Option(
            "--listen", help="Listening time at each speed and interface, s.", min=0.1, max=60.0
        ),
    ] = 1.0,
    physical_test: _PhysicalTest = None,
    config: _Config = Path("rig.toml"),
    step_s: _Step = 60.0,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """List serial ports, CAN interfaces and motion-capture servers; listen where requested.

    The command opens only the named ports, interfaces and hosts, and changes no setting of a
    device. It reads a port at the usual speeds of the installed drivers until a driver decodes the
    data; layouts of serial-table and can-table in rig.toml are tried, too. Then it prints lines for
    rig.toml. With --physical-test, the command opens the sensor as the daemon does, guides you
    through three rotations, and prints corrections of the coordinate frames in rig.toml. Exit
    codes: 0 every named device was recognized, or the frames are correct; 1 a device was not
    recognized, or the frames are wrong; 2 invalid options.
    """
    if physical_test is not None:
        if serial or can or mocap or network:
            raise ValueError(
                "--physical-test takes the port from rig.toml: omit the options for other devices"
            )
        _test_by_hand(physical_test, config, step_s, json=json)
        return
    hosts = [_host_and_port(text) for text in mocap or ()]

    import orjson

    from jointfit_daemon.tools.probe._described_layouts import described_layouts
    from jointfit_daemon.tools.probe._probe_report import report_lines

    layouts = described_layouts(config) if serial or can else {}
    report = _report(
        serial or (), can or (), hosts, network=network, listen_s=listen_s, layouts=layouts
    )
    if json:
        typer.echo(orjson.dumps(report, option=orjson.OPT_NON_STR_KEYS))
    else:
        for line in report_lines(report):
            typer.echo(line)
        for fault in report.faults:
            typer.echo(fault, err=True)
    if report.faults:
        raise typer.Exit(EXIT_FAILED)


def _test_by_hand(name: str, config: Path, step_s: float, *, json: bool) -> None:
    from jointfit_daemon.config import load_rig
    from jointfit_daemon.nearest_name import unknown_name
    from jointfit_daemon.tools.probe._physical_test import PhysicalTestError, run_physical_test
    from jointfit_daemon.tools.probe._test_report import test_lines
    from jointfit_daemon.tools.text_output import echo_json, echo_wrapped

    sensors = {source.id: source for source in load_rig(config).sources if source.kind == "imu"}
    if name not in sensors:
        raise ValueError(f"--physical-test: {unknown_name('sensor', name, list(sensors))}")

    def print_step(text: str) -> None:
        typer.echo(text, err=json)

    try:
        result = asyncio.run(run_physical_test(sensors[name], print_step, step_s=step_s))
    except PhysicalTestError as error:
        typer.echo(error, err=True)
        raise typer.Exit(EXIT_FAILED) from None
    if json:
        echo_json(result)
    else:
        for line in test_lines(result):
            echo_wrapped(line)
    if not result.agrees:
        raise typer.Exit(EXIT_FAILED)


def _host_and_port(text: str) -> tuple[str, int | None]:
    from jointfit_daemon.driver import host_fault

    host, colon, number = text.partition(":")
    port = int(number) if number.isascii() and number.isdigit() else 0
    if colon and not 1 <= port <= _MOST_PORT:
        raise ValueError(f"--mocap {text}: expected HOST or HOST:PORT, such as 192.168.1.20:1510")
    if (fault := host_fault(host)) is not None:
        raise ValueError(f"--mocap {text}: {fault}")
    return host, port or None


def _report(
    ports: Sequence[str],
    interfaces: Sequence[str],
    hosts: Sequence[tuple[str, int | None]],
    *,
    network: bool,
    listen_s: float,
    layouts: Layouts,
) -> ProbeReport:
    from rich.console import Console
    from rich.progress import Progress

    from jointfit_daemon.tools import discovery
    from jointfit_daemon.tools.probe._probe_report import ProbeReport
    from jointfit_daemon.tools.probe._rig_lines import rig_lines

    found_ports = discovery.find_serial_ports()
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:

        def listen_at(name: str) -> dict[str, object]:
            task = bar.add_task(f"listening on {name}", total=1.0)
            return {"progress": lambda share: bar.update(task, completed=share)}

        ports_read = [
            discovery.listen_serial(port, listen_s=listen_s, layouts=layouts, **listen_at(port))  # type: ignore[arg-type]  # one key
            for port in ports
        ]
        buses = [
            discovery.listen_can(name, listen_s=listen_s, layouts=layouts, **listen_at(name))  # type: ignore[arg-type]  # one key
            for name in interfaces
        ]
        servers: list[FoundServer] = []
        faults = _faults(ports_read, buses, listen_s)
        if hosts or network:
            bar.add_task("asking motion-capture servers", total=None)
            servers, unanswered = asyncio.run(_servers(hosts, network=network, wait_s=listen_s))
            faults += unanswered

    return ProbeReport(
        serial_ports=found_ports,
        can_interfaces=discovery.find_can_interfaces(),
        can_channels=discovery.configured_can_channels(),
        serial=ports_read,
        can=buses,
        mocap_servers=servers,
        faults=faults,
        rig_toml=rig_lines(found_ports, ports_read, buses, servers),
    )


async def _servers(
    hosts: Sequence[tuple[str, int | None]], *, network: bool, wait_s: float
) -> tuple[list[FoundServer], list[str]]:
    """Return the servers that answered, and an error text for each host without an answer."""
    from jointfit_daemon.tools.discovery import find_mocap_servers

    async def ask(name: str, port: int | None) -> list[FoundServer] | str:
        """Return the servers that answered, or the error text if no server answered."""
        named = name != _NETWORK
        try:
            answered = await find_mocap_servers(
                [name] if named else (), broadcast=not named, port=port, wait_s=wait_s
            )
        except OSError as error:
            return str(error) if named else f"{name}: the search failed: {error}: {_CARDS}"
        return answered or f"{name}: no motion-capture server answered: {_REMEDIES[named]}"

    async with asyncio.TaskGroup() as group:
        asked = [
            group.create_task(ask(name, port))
            for name, port in (*hosts, *([(_NETWORK, None)] if network else []))
        ]
    found: list[FoundServer] = []
    faults = []
    for answered in (task.result() for task in asked):
        if isinstance(answered, str):
            faults.append(answered)
        else:
            known = {(server.server, server.port) for server in found}
            found += [each for each in answered if (each.server, each.port) not in known]
    return found, faults


_NETWORK = "--network"
_CARDS = "check the network cards"
_REMEDIES = {
    True: "start the streaming, check address, port and firewall (`jointfit doctor --config "
    "rig.toml` names the cause)",
    False: "routers and firewalls stop broadcasts; name the server with --mocap HOST",
}
"""Remedy if no server answered; the key states whether the user named a host."""


def _faults(
    serial: Sequence[SerialTraffic], can: Sequence[CanTraffic], listen_s: float
) -> list[str]:
    """Return the reason and the remedy for each port or interface without recognized data."""
    faults = []
    for port in serial:
        if port.fault is not None:
            faults.append(port.fault)
        elif not any(port.received_bytes.values()):
            faults.append(
                f"{port.port}: no byte in {listen_s:g} s: check power and cable; a device that "
                "waits for a command (and an SLCAN adapter) is silent until the daemon opens it"
            )
        elif not port.devices:
            faults.append(
                f"{port.port}: {sum(port.received_bytes.values())} bytes, but no installed driver "
                "decodes them: check the speed of the device, or describe its data by a "
                "serial-table in rig.toml and repeat the command with --config"
            )

    for bus in can:
        if bus.fault is not None:
            faults.append(bus.fault)
        elif not bus.identifiers:
            faults.append(
                f"{bus.interface}: no frame in {listen_s:g} s: check power, the termination of the "
                "bus and the bit rate of the sensors"
            )
        elif not bus.devices:
            faults.append(
                f"{bus.interface}: {len(bus.identifiers)} identifiers, but no installed driver "
                "decodes them: check the messages that the sensors are configured to send"
            )
    return faults
