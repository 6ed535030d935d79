"""Handlers of the MQTT requests that the daemon executes.

The core (`jointfit_daemon.pipeline`) executes the other requests: ``calibrate``, ``static`` and
``mark``.

Invariant: a handler that refuses a request changes nothing.
"""

from __future__ import annotations

import asyncio
import math
import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Protocol

from jointfit_daemon.calibration.record import CalibrationFileError
from jointfit_daemon.config import ConfigError, Fault
from jointfit_daemon.nearest_name import nearest_name
from jointfit_daemon.pipeline.events import CalibrationSelected
from jointfit_daemon.supervisor._calibration_store import calibration_age_s, store_directory
from jointfit_daemon.supervisor._physical_test_handler import (
    RUNNING_PHASES,
    PhysicalTestHandler,
    TestedDaemon,
)
from jointfit_daemon.supervisor._self_test import read_host, result_of, self_test
from jointfit_daemon.supervisor._stored_versions import StoredVersions
from jointfit_daemon.supervisor.requests import error_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from jointfit_daemon.config import Rig
    from jointfit_daemon.outputs.recording import Recorder
    from jointfit_daemon.pipeline.events import Event, Reply, Request
    from jointfit_daemon.supervisor.requests import Handler


class DaemonInterface(TestedDaemon, Protocol):
    """Operations of the daemon that the handlers use."""

    def feed(self, event: Event) -> None:
        """Pass one event to the core."""

    @property
    def recorder(self) -> Recorder:
        """The recorder of the daemon."""

    async def reload(self, before_move: Callable[[Rig], None] | None = None) -> Rig | None:
        """Load rig.toml again and apply it. Raise `ConfigError` if the file is faulty."""

    async def set_output_rate(self, rate_hz: float) -> None:
        """Apply the current configuration with another output rate."""

    async def settle_store(self) -> None:
        """Wait until no calibration is being written."""


class RequestHandlers:
    """Request handlers of one daemon.

    Parameters
    ----------
    daemon
        Daemon that executes the changes.
    publish
        Function that publishes an answer before its handler has ended.
    """

    def __init__(self, daemon: DaemonInterface, publish: Callable[[Reply], None]) -> None:
        self._daemon, self._publish = daemon, publish
        self._stored = StoredVersions()
        self._physical_test = PhysicalTestHandler(daemon)

    def table(self) -> Mapping[str, Handler]:
        """Return the handlers by the name of their request."""
        return {
            "reload": self.reload,
            "restart-device": self.restart_device,
            "rate": self.rate,
            "calibrations": self.calibrations,
            "use-calibration": self.use_calibration,
            "selftest": self.selftest,
            "record": self.record,
            "physical-test": self._physical_test.handle,
        }

    async def reload(self, request: Request) -> Reply | None:
        """Load rig.toml again. If the file is faulty, the error lists all its faults.

        If the table ``[mqtt]`` has changed, the answer ``accepted`` is published before the daemon
        connects again.
        """

        def data(rig: Rig) -> dict[str, object]:
            return {"rig": rig.name, "devices": [source.id for source in rig.sources]}

        def accept(rig: Rig) -> None:
            self._publish(request.reply("accepted", data(rig)))

        try:
            rig = await self._daemon.reload(accept)
        except ConfigError as error:
            return request.reply("error", {}, error_of(error.faults))
        return None if rig is None else request.reply("ok", data(rig))

    async def restart_device(self, request: Request) -> Reply:
        """Close and open the port of one device. The topic ``availability`` shows the result."""
        name = str(request.arguments["device"])
        known = [source.id for source in self._daemon.rig.sources]
        if name not in known:
            expected = f"expected a device of rig.toml: {', '.join(known)}"
            fault = Fault("restart-device.device", expected, name, nearest_name(name, known))
            return request.reply("error", {}, error_of([fault]))
        await self._daemon.restart_device(name)
        return request.reply("accepted", {"device": name})

    async def rate(self, request: Request) -> Reply:
        """Change the output rate.

        The request is refused if the rate exceeds the sample rates of all sensors, or while a
        calibration phase is running.
        """
        rig, rate_hz = self._daemon.rig, float(str(request.arguments["hz"]))
        # A planar rig has no sensors, and its cameras determine the instants of the results.
        fastest_hz = max((s.rate_hz for s in rig.sources if s.kind == "imu"), default=math.inf)
        fault = None
        if rate_hz > fastest_hz:
            expected = f"expected at most {fastest_hz:g}, the sample rate of the fastest sensor"
            fault = Fault("rate.hz", expected, rate_hz)
        elif (phase := self._daemon.health().core.phase) in RUNNING_PHASES:
            expected = (
                f"calibration phase {phase} is running and would be aborted: wait until it ends"
            )
            fault = Fault("rate.hz", expected, rate_hz)
        if fault is not None:
            return request.reply("error", {}, error_of([fault]))

        before_hz = rig.output_rate_hz
        if rate_hz != before_hz:
            await self._daemon.set_output_rate(rate_hz)
        return request.reply("ok", {"before_hz": before_hz, "output_rate_hz": rate_hz})

    async def calibrations(self, request: Request) -> Reply:
        """List the stored calibrations."""
        count = int(str(request.arguments["count"]))
        try:
            found = await asyncio.to_thread(self._stored.list, self._daemon.rig, count)
        except OSError as error:
            return request.refusal("store", f"{error.filename}: {error.strerror}")
        in_force = self._daemon.health().core.version
        return request.reply("ok", {"in_force": in_force, **found})

    async def use_calibration(self, request: Request) -> Reply | None:
        """Load a stored version and pass it to the core, which sends the answer."""
        # A new calibration has no version number until its file is written. Without a number,
        # `before` returns the newest file. If the new calibration were written just before this
        # search, a request to revert would select the calibration in use, not an earlier one.
        await self._daemon.settle_store()
        rig, in_force = self._daemon.rig, self._daemon.health().core.version
        version = request.arguments.get("version")
        try:
            if version is None:
                version = await asyncio.to_thread(self._stored.before, rig, in_force)
            if version is None:
                return request.refusal("revert", "no older version is stored for this limb")
            number = int(str(version))
            if number == in_force:
                phase = self._daemon.health().core.phase
                return request.reply("ok", {"version": number, "phase": phase})
            chosen = await asyncio.to_thread(self._stored.load, rig, number)
        except (CalibrationFileError, OSError) as error:
            return request.refusal("version", str(error))

        age_s = calibration_age_s(chosen)
        self._daemon.feed(CalibrationSelected(time.monotonic_ns(), chosen, number, age_s, request))
        return None

    async def record(self, request: Request) -> Reply:
        """Start or stop the recording, or return its state. Repeated requests have no effect."""
        recorder, action = self._daemon.recorder, request.arguments["action"]
        try:
            if action == "start":
                health = await recorder.start()
            elif action == "stop":
                health = await recorder.stop()
            else:
                health = recorder.health()
        except OSError as error:
            text = f"the file cannot be created: {error}: correct the folder of [recording]"
            return request.refusal("record.action", text)

        found = asdict(health)
        del found["backlog_bytes"]
        return request.reply("ok", {"directory": str(recorder.directory.absolute()), **found})

    async def selftest(self, request: Request) -> Reply:
        """Check devices, clocks, calibration store, broker and host."""
        rig = self._daemon.rig
        host = await asyncio.to_thread(read_host, store_directory(rig))
        return request.reply("ok", result_of(self_test(rig, self._daemon.health(), host)))
