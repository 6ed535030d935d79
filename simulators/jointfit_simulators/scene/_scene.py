"""Real-time scene, which connects subject, devices, streams and ground-truth log."""

from __future__ import annotations

import asyncio
import dataclasses
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from jointfit_daemon.units import NS_PER_S
from jointfit_simulators.body import (
    SimulatedSubject,
    UnknownMotionError,
    leg_parts,
    misplaced_markers,
    model_toml,
    to_wxyz,
)
from jointfit_simulators.devices import Cameras, SampleTiming
from jointfit_simulators.scene._hardware import WIRES, create_hardware
from jointfit_simulators.scene._imu_families import BUS, IMU_FAMILIES
from jointfit_simulators.scene._mocap_families import MOCAP_FAMILIES, CameraPlace
from jointfit_simulators.scene._optical_stream import OpticalStream
from jointfit_simulators.scene._player import ScenePlayer
from jointfit_simulators.scene._rig_file import RigOptions, rig_toml
from jointfit_simulators.scene._sample_log import SampleLog
from jointfit_simulators.scene._truth_log import TruthLog
from jointfit_simulators.wires import wait_until_read

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from jointfit_simulators.body import InstrumentedSubject
    from jointfit_simulators.devices import ClockFault
    from jointfit_simulators.scene._mocap_families import MocapServer
    from jointfit_simulators.scene._player import PlannedStream
    from jointfit_simulators.scene._streams import ImuStream
    from jointfit_simulators.settings import Knobs
    from jointfit_simulators.wires import CanWire

RIG_FILE = "rig.toml"
MODEL_FILE = "leg.toml"
"""File name of the subject's chain model. Its marker positions have errors of about 1 cm."""
TRUTH_FILE = "truth.jsonl"
SAMPLES_FILE = "samples.jsonl"
PLANAR_MARKERS = {"pelvis": ("P1",), "thigh": ("T1", "T4"), "shank": ("C1", "C4"), "foot": ("F1",)}
"""Markers of a rig for planar movement, by body part. The cameras also stream other markers."""
OPTICAL = "mocap"
"""Name of the motion-capture server in commands and in the log of the ground truth."""
DOWN_S = 1.0
"""Downtime of the motion-capture server during a restart, s."""


@dataclass(frozen=True)
class SceneOptions:
    """Hardware, clock faults and scheduled commands of a scene."""

    directory: Path
    mocap: str | None = "natnet"
    """Driver of the motion-capture server; None without cameras."""
    can: str = "slcan"
    wires: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Driver of a sensor, by sensor id; other sensors have the default driver."""
    rig: RigOptions = dataclasses.field(default_factory=RigOptions)
    clocks: Mapping[str, ClockFault] = dataclasses.field(default_factory=dict)
    """Prescribed clock errors, by sensor id or ``mocap``; all other clock errors are random."""
    script: tuple[tuple[float, str], ...] = ()
    """Scheduled commands: each has a time since the start of the run, s, and a command line."""
    sync_line: bool = False
    """Whether the cameras' sync output is connected to the first sync input of UART sensors."""
    ptp: bool = False
    """Whether cameras and host are synchronized by PTP."""
    command_port: int = 0
    """Port to which clients of the motion-capture server connect; 0 selects a free port."""
    chain_model: bool = False
    """Whether a chain model of the simulated subject is written and named in rig.toml."""
    planar: bool = False
    """Whether the scene has cameras only, and rig.toml describes a planar movement."""
    sample_log: bool = False
    """Whether the true sampling time of each sent sample is logged."""


class InvalidCommandError(ValueError):
    """Invalid command; the message lists the valid commands."""


class Scene:
    """Running virtual hardware.

    Parameters
    ----------
    knobs
        Settings with the magnitudes of all errors.
    subject
        Subject with the sensors and markers.
    options
        Hardware configuration.
    now_ns
        Host time that corresponds to the subject's time 0, ns.
    """

    def __init__(
        self, knobs: Knobs, subject: InstrumentedSubject, options: SceneOptions, *, now_ns: int
    ) -> None:
        self._options, self._subject = options, subject
        _check_clocks(options.clocks, (*subject.sensors, OPTICAL))
        _check_families(options, subject.sensors)
        options.directory.mkdir(parents=True, exist_ok=True)
        self._knobs = knobs
        self._hardware = create_hardware(
            knobs,
            {} if options.planar else subject.sensors,
            options.directory,
            wires={**WIRES, **options.wires},
            can=options.can,
            now_ns=now_ns,
            sync_line=options.sync_line,
        )

        timing = SampleTiming(knobs, OPTICAL, latency_ms=knobs.latency_mocap_ms, now_ns=now_ns)
        streams = self._hardware.streams
        self._timings = {n: s.timing for n, s in streams.items()} | {OPTICAL: timing}
        for name, fault in options.clocks.items():
            self._timings[name].set_fault(fault, now_ns)

        cameras = Cameras(knobs, subject, rate_hz=knobs.mocap_hz)
        self._server, self._mocap_lines = _create_cameras(
            options, CameraPlace(knobs, subject.clusters, cameras.bodies, timing, options.ptp,
                                 options.command_port),
        )  # fmt: skip
        self._optical = OpticalStream(knobs, cameras, timing, self._server)

        samples = SampleLog(options.directory / SAMPLES_FILE) if options.sample_log else None
        self._samples = samples
        planned: list[PlannedStream] = [*streams.values(), self._optical]
        for stream in planned:
            stream.on_sample = samples.add if samples else None

        self._origin_ns = now_ns
        self._truth = TruthLog(options.directory / TRUTH_FILE, self._facts(knobs, now_ns))
        self._player = ScenePlayer(
            subject,
            streams,
            self._optical,
            self._truth,
            origin_ns=now_ns,
            sync_line=options.sync_line,
        )
        self._quit = asyncio.Event()
        self._commands = self._command_table(cameras)

    def _command_table(self, cameras: Cameras) -> dict[str, Callable[[str], None]]:
        """Return the handlers by command name; each receives the arguments as text."""
        return {
            "play": self._player.play,
            "unplug": lambda name: self._connection(name).unplug(),
            "plug": lambda name: self._connection(name).plug(),
            "reboot": self._reboot,
            "stick": lambda name: self._stream(name).faults.stick(),
            "free": lambda name: self._stream(name).faults.free(),
            "slip": self._slip,
            "drift": self._drift,
            "occlude": lambda word: setattr(cameras, "covered", _switch(word)),
            "hide": lambda name: cameras.hide(_marker(cameras, name)),
            "show": lambda name: cameras.show(_marker(cameras, name)),
            "exchange": lambda words: cameras.exchange(
                *(_marker(cameras, name) for name in _two_names(words, "exchange T1 T3"))
            ),
            "mocap": self._mocap,
            "pause": lambda word: setattr(self._player, "paused", _switch(word or "on")),
            "quit": lambda _: self._quit.set(),
        }

    def _facts(self, knobs: Knobs, now_ns: int) -> dict[str, object]:
        """Return the contents of the first line of the ground-truth log."""
        cameras, streams = self._optical.cameras, self._hardware.streams
        return {
            "t_ns": now_ns,
            "knobs": dataclasses.asdict(knobs),
            "sensors": dict(self._subject.sensors),
            "optical_heading_rad": cameras.heading_rad,
            "sensor_heading_rad": {n: s.sensor.heading_rad for n, s in streams.items()},
            "q_optical_sensorworld": {
                n: to_wxyz(cameras.world * s.sensor.world.inv()) for n, s in streams.items()
            },
            "clocks": {
                n: {"boot_ns": timing.clock.boot_ns, "skew": timing.clock.skew}
                for n, timing in self._timings.items()
            },
            **self._subject.facts,
        }

    async def run(self, report: Callable[[dict[str, object]], None]) -> None:
        """Run until `stop`, then wait until all bytes are read and close all ports.

        Parameters
        ----------
        report
            Callback. It receives the ports when all devices are ready, and the counts at the end.
        """
        try:
            async with asyncio.TaskGroup() as tasks:
                serving = [
                    tasks.create_task(stream.device.run(), name=f"device {name}")
                    for name, stream in self._hardware.streams.items()
                ]
                if self._server is not None:
                    serving.append(tasks.create_task(self._server.run(), name="mocap"))
                    await self._server.ready.wait()

                rig = self._write_rig()
                playing = tasks.create_task(self._player.run(), name="player")
                following = tasks.create_task(self._follow_script(report), name="script")
                truth = self._options.directory / TRUTH_FILE
                report({"ready": True, "rig": str(rig), "truth": str(truth), "ports": self.ports})

                await self._quit.wait()
                playing.cancel()
                following.cancel()
                self._player.finish()
                report(self.account())
                await wait_until_read(Path(port) for port in self.ports.values())
                for task in serving:
                    task.cancel()
        finally:  # even after an error or a cancellation
            self.close()

    async def _follow_script(self, report: Callable[[dict[str, object]], None]) -> None:
        """Run the scheduled commands."""
        for at_s, line in sorted(self._options.script):
            due_ns = self._origin_ns + round(at_s * NS_PER_S)
            await asyncio.sleep(max(0.0, (due_ns - time.monotonic_ns()) / NS_PER_S))
            try:
                self.command(line)
            except InvalidCommandError as error:
                report({"error": str(error)})

    def stop(self) -> None:
        """End `run`."""
        self._quit.set()

    def close(self) -> None:
        """Close the logs and unplug all devices."""
        self._truth.close()
        if self._samples is not None:
            self._samples.close()
        for stream in self._hardware.streams.values():
            stream.device.unplug()
        if self._server is not None:
            self._server.unplug()

    def _write_rig(self) -> Path:
        planar = self._options.planar
        path = self._options.directory / RIG_FILE
        text = rig_toml(
            self._options.rig,
            devices=self._hardware.tables,
            mocap="\n".join(self._mocap_lines),
            clusters=PLANAR_MARKERS if planar else self._subject.clusters,
            bones=self._subject.visible_bones,
            plate="plate" in self._subject.templates and not planar,
            chain=self._subject.chain,
            chain_model=self._write_model(),
            planar=planar,
        )
        path.write_text(text, encoding="utf-8")
        return path

    def _write_model(self) -> str | None:
        """Write the chain model if requested; return the name of its file."""
        subject = self._subject
        if not self._options.chain_model or not isinstance(subject, SimulatedSubject):
            return None
        parts = leg_parts(subject.geometry)
        random = self._knobs.random("model")
        markers = misplaced_markers(random, subject.clusters, subject.templates, parts)
        text = model_toml(parts, markers)
        (self._options.directory / MODEL_FILE).write_text(text, encoding="utf-8")
        return MODEL_FILE

    @property
    def ports(self) -> Mapping[str, str]:
        """Port of each device or bus, by name."""
        return self._hardware.ports

    @property
    def command_port(self) -> int | None:
        """Port to which clients of the motion-capture server connect; None without a server."""
        return None if self._server is None else self._server.command_port

    def command(self, line: str) -> dict[str, object] | None:
        """Run one command; return the result of ``status``, or None for other commands.

        Raises
        ------
        InvalidCommandError
            The command, motion, sensor or argument is unknown.
        """
        verb, _, rest = line.strip().partition(" ")
        if verb == "status":
            return self.status()

        if verb not in self._commands:
            raise InvalidCommandError(
                f"no command {verb!r}; there are: {', '.join(self._commands)}, status"
            )
        try:
            self._commands[verb](rest.strip())
        except UnknownMotionError as error:
            raise InvalidCommandError(str(error)) from error
        return None

    def _reboot(self, name: str) -> None:
        if name == OPTICAL:
            self._restart_server(reset_clock=True)
        else:
            self._stream(name).device.power_cycle()

    def _slip(self, words: str) -> None:
        stream, degrees = self._sensor_and_number(words, "slip S1 15 (degrees)")
        stream.faults.slip(math.radians(degrees))

    def _drift(self, words: str) -> None:
        stream, degrees = self._sensor_and_number(words, "drift S1 5 (degrees a minute)")
        stream.faults.drift(math.radians(degrees) / 60.0)

    def _sensor_and_number(self, words: str, example: str) -> tuple[ImuStream, float]:
        name, _, number = words.partition(" ")
        stream = self._stream(name)
        try:
            value = float(number)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InvalidCommandError(f"{words!r}: expected a sensor and a number, as in {example}")
        return stream, value

    def _mocap(self, word: str) -> None:
        if word == "restart":
            self._restart_server(reset_clock=False)
        else:
            self._optical.running = _switch(word)

    def _restart_server(self, *, reset_clock: bool) -> None:
        """Close the server and reopen it after `DOWN_S`."""
        server = self._server
        if server is None:
            raise InvalidCommandError("there is no motion-capture server")
        server.unplug()
        if reset_clock:
            self._timings[OPTICAL].reboot(time.monotonic_ns())
        asyncio.get_running_loop().call_later(DOWN_S, server.restart)

    def _stream(self, name: str) -> ImuStream:
        streams = self._hardware.streams
        if name not in streams:
            raise InvalidCommandError(f"no sensor {name!r}; there are: {', '.join(streams)}")
        return streams[name]

    def _connection(self, name: str) -> ImuStream | CanWire:
        """Return the sensor or the bus adapter with this name, to connect or disconnect it."""
        if name == BUS and self._hardware.bus is not None:
            return self._hardware.bus
        return self._stream(name)

    def status(self) -> dict[str, object]:
        """Return the motion and the state of each device, as JSON values."""
        return {
            "t_ns": time.monotonic_ns(),
            "motion": self._player.motion(),
            "devices": {n: s.status() for n, s in self._hardware.streams.items()},
            "mocap": {"sent": self._optical.sent, "running": self._optical.running},
            "left_out_ms": self._player.left_out_ns / 1e6,
        }

    def account(self) -> dict[str, object]:
        """Return the total numbers of samples of each device, by the names of the counters."""
        streams = self._hardware.streams
        return {
            "sent": {**{n: s.device.sent for n, s in streams.items()}, "mocap": self._optical.sent},
            "dropped_out": {n: s.dropped_out for n, s in streams.items()},
            "refused": {n: s.refused for n, s in streams.items()},
            "unheard": {n: s.unheard for n, s in streams.items()},
        }


def _check_clocks(clocks: Iterable[str], known: tuple[str, ...]) -> None:
    for name in clocks:
        if name not in known:
            raise InvalidCommandError(f"no clock {name!r}; there are: {', '.join(known)}")


def _check_families(options: SceneOptions, sensors: Mapping[str, str]) -> None:
    if unknown := [name for name in options.wires if name not in sensors]:
        raise InvalidCommandError(f"no sensor {unknown[0]!r}; there are: {', '.join(sensors)}")
    for driver in options.wires.values():
        if driver not in IMU_FAMILIES:
            raise InvalidCommandError(
                f"no simulated IMU of driver {driver!r}; there are: {', '.join(IMU_FAMILIES)}"
            )
    if options.mocap is not None and options.mocap not in MOCAP_FAMILIES:
        raise InvalidCommandError(
            f"no simulated cameras of driver {options.mocap!r}; there are: "
            f"{', '.join(MOCAP_FAMILIES)}"
        )


def _create_cameras(
    options: SceneOptions, place: CameraPlace
) -> tuple[MocapServer | None, list[str]]:
    """Return the motion-capture server, if there is one, and the lines of its table in rig.toml."""
    if options.mocap is None:
        return None, []
    family = MOCAP_FAMILIES[options.mocap]
    server, lines = family.create(place)
    sync = ["sync_line = 0"] if options.sync_line and family.sync_line else []
    return server, ["[mocap]", f'driver = "{options.mocap}"', *lines, *sync]


def _marker(cameras: Cameras, name: str) -> str:
    if name not in cameras.markers:
        raise InvalidCommandError(f"no marker {name!r}; there are: {', '.join(cameras.markers)}")
    return name


def _two_names(words: str, example: str) -> list[str]:
    names = words.split()
    if len(names) != 2:  # noqa: PLR2004 - a pair
        raise InvalidCommandError(f"{words!r}: expected two markers, such as {example}")
    return names


def _switch(word: str) -> bool:
    words = {"on": True, "start": True, "off": False, "stop": False}
    if word not in words:
        raise InvalidCommandError(f"{word!r}: expected {' or '.join(words)}")
    return words[word]
