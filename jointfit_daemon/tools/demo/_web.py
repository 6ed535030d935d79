"""The demo in a browser, which runs simulated hardware, daemon and dashboard until Ctrl-C.

The simulated subject follows the calibration phases, so a user can calibrate in the page.
"""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from jointfit_daemon.tools.calibrate import (
    PhaseAbortedError,
    PhaseTracker,
    RequestRefusedError,
    raise_if_refused,
)
from jointfit_daemon.tools.child_processes import daemon, simulator, time_limit
from jointfit_daemon.tools.dashboard.addresses import BrokerAddress
from jointfit_daemon.tools.dashboard.server import DashboardServer
from jointfit_daemon.tools.embedded_broker import HOST, embedded_broker
from jointfit_daemon.tools.stop_signals import cancel_on_signal

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.config import Rig
    from jointfit_daemon.outputs.mqtt import MqttClient
    from jointfit_daemon.tools.child_processes import ChildProcess
    from jointfit_daemon.tools.dashboard.addresses import ListenAddress

CONNECT_S = 60.0
"""Time limit for connecting all sources, s."""
SETTLE_S = 3.0
"""Time for the device clocks to converge, s."""
PHASES = (("align", 20.0), ("static", 5.0), ("functional", 47.0))
"""Phases of the calibration and their durations, s."""
TOPICS = ("calibration", "calibration/progress", "device/+/availability")
ATTEMPTS = 3
"""Maximum number of attempts at each phase. A busy computer delays the simulated sensors, and the
daemon then aborts the phase."""
STOPPED_BY_USER = "abort requested"
"""Last words of the abort reason if a user stopped the phase in the page."""
LIVE = "The page shows the live limb. You can calibrate it again there; Ctrl-C stops the demo."
UNCALIBRATED = "The limb is not calibrated. Calibrate it in the page; Ctrl-C stops the demo."


async def run_web_demo(
    folder: Path, base: str, options: Sequence[str], listen: ListenAddress
) -> None:
    """Print the URL of the page, and run until a stop signal.

    Parameters
    ----------
    folder
        Folder for rig, logs and calibration.
    base
        Base topic.
    options
        Options of the simulator.
    listen
        Address of the page.
    """
    with cancel_on_signal() as stop:
        try:
            with embedded_broker(folder) as port:
                server = DashboardServer(BrokerAddress(HOST, port), base=base)
                async with server.listening(listen) as url:
                    print_address(url, listen)
                    more = ("--follow", "--sensors-hz", "10")
                    async with simulator(folder, port, base, [*options, *more]) as simulated:
                        rig_file = Path((await simulated.ready())["rig"])
                        async with daemon(folder, rig_file) as process:
                            from jointfit_daemon.config import load_rig  # slow import

                            typer.echo(await _calibrate(load_rig(rig_file), process))
                            while True:
                                process.check()
                                simulated.check()
                                await asyncio.sleep(1.0)
        except asyncio.CancelledError:
            if stop.number is None:
                raise


def print_address(url: str, listen: ListenAddress) -> None:
    """Print the URL.

    If other devices can open the page and segno is installed, a QR code follows.
    """
    typer.echo(f"dashboard: {url}  (Ctrl-C stops)")
    if listen.is_local:
        typer.echo("For a phone in the same network: --listen 0.0.0.0:8080")
        return
    try:
        import segno
    except ModuleNotFoundError:
        typer.echo("For a QR code: pip install 'jointfitd[demo]'")
        return
    segno.make(url, error="l").terminal(compact=True)


async def _calibrate(rig: Rig, process: ChildProcess) -> str:
    """Run the phases in order, and return the result as text.

    If a phase is refused or aborted, the later phases are omitted. A possible reason is that the
    user starts phases in the page.
    """
    from jointfit_daemon.outputs.mqtt import MqttClient

    online: set[str] = set()
    async with MqttClient(rig.mqtt) as client:
        await client.subscribe(*TOPICS)
        tracker = PhaseTracker(lambda *_: None)
        listener = asyncio.create_task(_listen(client, tracker, online), name="demo listener")
        try:
            async with time_limit(CONNECT_S, "connecting all sources"):
                while not {source.id for source in rig.sources} <= online:
                    process.check()
                    await asyncio.sleep(0.1)
            await asyncio.sleep(SETTLE_S)
            for phase, seconds in PHASES:
                await run_phase(client, tracker, phase, seconds)
        except (PhaseAbortedError, RequestRefusedError) as ended:
            typer.echo(f"calibration: {ended}", err=True)
        finally:
            listener.cancel()
            await asyncio.wait([listener])
    return LIVE if tracker.status.get("version") is not None else UNCALIBRATED


async def run_phase(client: MqttClient, tracker: PhaseTracker, phase: str, seconds: float) -> None:
    """Run a phase; after an abort by the daemon, repeat it, with at most `ATTEMPTS` attempts."""
    for attempt in range(1, ATTEMPTS + 1):
        typer.echo(f"calibration: {phase}, {seconds:g} s")
        tracker.begin()
        raise_if_refused(await client.request("calibrate", {"phase": phase, "seconds": seconds}))
        try:
            await tracker.wait_for_end(phase)
        except PhaseAbortedError as aborted:
            if attempt == ATTEMPTS or str(aborted).endswith(STOPPED_BY_USER):
                raise
            typer.echo(f"calibration: {aborted}", err=True)
        else:
            return


async def _listen(client: MqttClient, tracker: PhaseTracker, online: set[str]) -> None:
    async for topic, payload in client.messages():
        if not isinstance(payload, dict):
            continue
        if topic == "calibration":
            tracker.on_status(payload)
        elif topic.endswith("/availability"):
            (online.add if payload.get("state") == "online" else online.discard)(
                topic.split("/")[1]
            )
