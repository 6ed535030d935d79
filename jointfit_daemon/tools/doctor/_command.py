"""Command `jointfit doctor`: checks of host, devices, broker and cameras."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from jointfit_daemon.tools.command_group import EXIT_FAILED

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.config import Rig, Source
    from jointfit_daemon.device_search import Diagnosis, Finding
    from jointfit_daemon.tools.doctor._host import Host

_DEFAULT = Path("rig.toml")


def doctor(
    *,
    config: Annotated[
        Path | None,
        typer.Option(help="Configuration to check. Default: rig.toml, if this folder contains it."),
    ] = None,
    wait_s: Annotated[
        float,
        typer.Option("--wait", help="Longest wait for frames of the cameras, s.", min=0.5, max=60),
    ] = 3.0,
    json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
) -> None:
    """Find the faults that keep data from the daemon, each with its remedy.

    The command checks serial ports (permissions, other programs, latency), CAN interfaces, clock,
    disk, memory and processor. With a rig.toml, it also checks the broker, identifies the sensors
    on serial ports from the data that they send, and connects to the cameras as the daemon does. It
    changes nothing, and needs no root access. Exit codes: 0 no error (warnings are possible); 1 an
    error; 2 invalid options or rig.toml.
    """
    from rich.console import Console
    from rich.progress import Progress

    from jointfit_daemon.config import load_rig
    from jointfit_daemon.tools.doctor._doctor_report import finding_lines, report_of
    from jointfit_daemon.tools.doctor._host import Host
    from jointfit_daemon.tools.text_output import echo_json, echo_wrapped

    chosen = config or (_DEFAULT if _DEFAULT.exists() else None)
    rig = None if chosen is None else load_rig(chosen)
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("checking", total=1.0)
        findings = examine(Host(), rig, wait_s, lambda share: bar.update(task, completed=share))

    report = report_of(findings)
    if json:
        echo_json(report)
    else:
        for finding in findings:
            for line in finding_lines(finding):
                echo_wrapped(line)
    if report.level == "error":
        raise typer.Exit(EXIT_FAILED)


def examine(
    host: Host, rig: Rig | None, wait_s: float, progress: Callable[[float], None] = lambda _: None
) -> list[Finding]:
    """Return all findings about a host, and about a rig if there is one.

    Parameters
    ----------
    host
        The host to check.
    rig
        Contents of rig.toml. Without a rig, all devices of the host are checked, but no broker and
        no cameras.
    wait_s
        Longest wait for frames of the cameras, s.
    progress
        Callback that receives the completed share, 0 to 1.
    """
    from jointfit_daemon.device_search import Finding
    from jointfit_daemon.tools.doctor import _host_checks as of_host
    from jointfit_daemon.tools.doctor._can_checks import check_can
    from jointfit_daemon.tools.doctor._serial_checks import check_serial
    from jointfit_variant import running_variant

    cameras = None if rig is None else next((s for s in rig.sources if s.kind == "mocap"), None)
    by_ptp = cameras is not None and getattr(cameras.settings, "time", "server") != "server"
    findings = [
        *check_serial(host, None if rig is None else _serial_paths(rig)),
        *check_can(host, None if rig is None else _can_bitrates(rig)),
        *of_host.check_clock(host, needed=by_ptp),
        *of_host.check_disk(host),
        *of_host.check_memory(host),
        *of_host.check_processor(host),
        Finding("software", "", "ok", f"modules that compute each frame: {running_variant()}"),
    ]
    progress(0.2)
    if rig is None:
        text = "no rig.toml: broker and cameras were not checked"
        return [*findings, Finding("rig", "", "unknown", text, "jointfit doctor --config rig.toml")]

    from jointfit_daemon.tools.doctor._broker_checks import check_broker
    from jointfit_daemon.tools.doctor._device_checks import check_devices

    findings += check_devices(host, rig.sources)
    findings += asyncio.run(check_broker(rig.mqtt))
    progress(0.4)
    if cameras is not None:
        found = asyncio.run(_diagnose(cameras, wait_s))
        findings += found
        server = getattr(cameras.settings, "server", None)
        if server is not None and any(each.level == "error" for each in found):
            findings += of_host.check_firewall(host, server)
    progress(1.0)
    return findings


async def _diagnose(cameras: Source, wait_s: float) -> list[Finding]:
    """Return the findings of the motion-capture driver."""
    from jointfit_daemon.device_search import Finding

    if not hasattr(cameras.driver_class, "diagnose"):
        text = f"driver {cameras.driver} has no diagnosis: the stream was not checked"
        return [
            Finding("mocap", cameras.driver, "unknown", text, "start jointfitd and read its log")
        ]
    driver = cast("Diagnosis", cast("Any", cameras.driver_class))
    return await driver.diagnose(cameras.settings, wait_s)


def _serial_paths(rig: Rig) -> list[str]:
    """Return the serial ports of a rig, for sensors and for CAN adapters."""
    from jointfit_daemon.driver import SERIAL_ADAPTERS

    paths = []
    for source in rig.sources:
        can = getattr(source.settings, "can", None)
        if can is not None and can.interface in SERIAL_ADAPTERS:
            paths.append(can.channel)
        elif isinstance(port := getattr(source.settings, "port", None), str):
            paths.append(port)
    return list(dict.fromkeys(paths))


def _can_bitrates(rig: Rig) -> dict[str, int | None]:
    """Return the SocketCAN interfaces of a rig with their configured bit rates, bit/s."""
    buses = (getattr(source.settings, "can", None) for source in rig.sources)
    return {
        bus.channel: bus.bitrate if "bitrate" in bus.model_fields_set else None
        for bus in buses
        if bus and bus.interface == "socketcan"
    }
