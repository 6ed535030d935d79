"""Real-time scene: connects subject, devices, streams and ground-truth log, and runs commands."""

from __future__ import annotations

import asyncio
import dataclasses
import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from jointfit_simulators.body import UnknownMotionError, to_wxyz
from jointfit_simulators.devices import NS, Cameras, SampleTiming
from jointfit_simulators.scene._hardware import WIRES, create_hardware, mocap_table, optical_server
from jointfit_simulators.scene._optical_stream import OpticalStream
from jointfit_simulators.scene._player import ScenePlayer
from jointfit_simulators.scene._rig_file import RigOptions, rig_toml
from jointfit_simulators.scene._sample_log import SampleLog
from jointfit_simulators.scene._truth_log import TruthLog

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from jointfit_simulators.body import InstrumentedSubject
    from jointfit_simulators.devices import ClockFault, NatNetServer
    from jointfit_simulators.scene._streams import ImuStream
    from jointfit_simulators.settings import Knobs

RIG_FILE = "rig.toml"
TRUTH_FILE = "truth.jsonl"
SAMPLES_FILE = "samples.jsonl"
OPTICAL = "mocap"
DOWN_S = 1.0
"""Downtime of the motion-capture server during a restart."""
LINGER_S = 0.3
"""Delay between the last byte and closing the ports, so that the host can read all data."""


@dataclass(frozen=True)
class SceneOptions:
    """Hardware, clock faults and scheduled commands of a scene."""

    directory: Path
    mocap: bool = True
    can: str = "slcan"
    wires: Mapping[str, str] = dataclasses.field(default_factory=lambda: WIRES)
    rig: RigOptions = dataclasses.field(default_factory=RigOptions)
    clocks: Mapping[str, ClockFault] = dataclasses.field(default_factory=dict)
    """Prescribed clock errors by sensor or ``mocap``; others are random."""
    script: tuple[tuple[float, str], ...] = ()
    """Scheduled commands: time since the start of the run in s, and command line."""
    sync_line: bool = False
    """Whether the cameras' sync output is connected to the first sync input of UART sensors."""
    ptp: bool = False
    """Whether cameras and host are synchronized by PTP."""
    command_port: int = 0
    """UDP port of the motion-capture server; 0 selects a free port."""
    sample_log: bool = False
    """Whether the true sampling time of each sample sent is logged."""


class InvalidCommandError(ValueError):
    """Invalid command; the message names the valid ones."""


class Scene:
    """Running virtual hardware.

    Parameters
    ----------
    knobs
        Error magnitudes.
    subject
        Subject wearing the sensors.
    options
        Hardware configuration.
    now_ns
        Host time at which the subject's time is 0, ns.
    """

    def __init__(
        self, knobs: Knobs, subject: InstrumentedSubject, options: SceneOptions, *, now_ns: int
    ) -> None:
        self._options, self._subject = options, subject
        _check_clocks(options.clocks, (*subject.sensors, OPTICAL))
        options.directory.mkdir(parents=True, exist_ok=True)
        self._hardware = create_hardware(
            knobs,
            subject.sensors,
            options.directory,
            wires=options.wires,
            can=options.can,
            now_ns=now_ns,
            sync_line=options.sync_line,
        )
        cameras = Cameras(knobs, subject, rate_hz=knobs.mocap_hz)
        samples = options.directory / SAMPLES_FILE
        self._samples = SampleLog(samples) if options.sample_log else None
        told = None if self._samples is None else self._samples.add
        ticker = SampleTiming(knobs, OPTICAL, latency_ms=knobs.latency_mocap_ms, now_ns=now_ns)
        self._tickers = {n: s.ticker for n, s in self._hardware.streams.items()} | {OPTICAL: ticker}
        for name, fault in options.clocks.items():
            self._tickers[name].set_fault(fault, now_ns)
        for stream in self._hardware.streams.values():
            stream.told = told
        self._server: NatNetServer | None = None
        if options.mocap:
            self._server = optical_server(
                knobs,
                subject.clusters,
                cameras.bodies,
                ticker,
                ptp=options.ptp,
                command_port=options.command_port,
            )
        self._optical = OpticalStream(knobs, cameras, ticker, self._server, told)
        self._origin_ns = now_ns
        self._truth = TruthLog(options.directory / TRUTH_FILE, self._facts(knobs, now_ns))
        self._player = ScenePlayer(
            subject,
            self._hardware.streams,
            self._optical,
            self._truth,
            origin_ns=now_ns,
            sync_line=options.sync_line,
        )
        self._quit = asyncio.Event()
        self._verbs = self._commands(cameras)

    def _commands(self, cameras: Cameras) -> dict[str, Callable[[str], None]]:
        """Return the handlers by command name; each receives the arguments as text."""
        return {
            "play": self._play,
            "unplug": lambda name: self._plugs(name)[0](),
            "plug": lambda name: self._plugs(name)[1](),
            "reboot": self._reboot,
            "stick": lambda name: self._stream(name).faults.stick(),
            "free": lambda name: self._stream(name).faults.free(),
            "slip": self._slip,
            "drift": self._drift,
            "occlude": lambda word: setattr(cameras, "covered", _on(word)),
            "mocap": self._mocap,
            "pause": lambda word: setattr(self._player, "paused", _on(word or "on")),
            "quit": lambda _: self._quit.set(),
        }

    def _facts(self, knobs: Knobs, now_ns: int) -> dict[str, object]:
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
                n: {"boot_ns": ticker.clock.boot_ns, "skew": ticker.clock.skew}
                for n, ticker in self._tickers.items()
            },
            **self._subject.facts,
        }

    async def run(self, say: Callable[[dict[str, object]], None]) -> None:
        """Run until `stop`, then wait `LINGER_S` and close all ports.

        Parameters
        ----------
        say
            Called with the ports when all devices are ready, and with the counts at the end.
        """
        try:
            async with asyncio.TaskGroup() as tasks:
                serving = [
                    tasks.create_task(stream.device.run(), name=f"device {name}")
                    for name, stream in self._hardware.streams.items()
                ]
                if self._server is not None:
                    serving.append(tasks.create_task(self._server.run(), name="natnet"))
                    await self._server.ready.wait()
                rig = self._write_rig()
                playing = tasks.create_task(self._player.run(), name="player")
                following = tasks.create_task(self._follow_script(say), name="script")
                truth = self._options.directory / TRUTH_FILE
                ports = self._hardware.ports
                say({"ready": True, "rig": str(rig), "truth": str(truth), "ports": ports})
                await self._quit.wait()
                playing.cancel()
                following.cancel()
                self._player.finish()
                say(self.account())
                await asyncio.sleep(LINGER_S)
                for task in serving:
                    task.cancel()
        finally:  # also after an error or cancellation
            self.close()

    async def _follow_script(self, say: Callable[[dict[str, object]], None]) -> None:
        """Run the scheduled commands."""
        for at_s, line in sorted(self._options.script):
            due_ns = self._origin_ns + round(at_s * NS)
            await asyncio.sleep(max(0.0, (due_ns - time.monotonic_ns()) / NS))
            try:
                self.command(line)
            except InvalidCommandError as error:
                say({"error": str(error)})

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
        path = self._options.directory / RIG_FILE
        text = rig_toml(
            self._options.rig,
            devices=self._hardware.tables,
            mocap=self._mocap_table(),
            clusters=self._subject.clusters,
            bones=self._subject.visible_bones,
            plate="plate" in self._subject.templates,
        )
        path.write_text(text, encoding="utf-8")
        return path

    def _mocap_table(self) -> str:
        if self._server is None:
            return ""
        return mocap_table(self._server, sync_line=self._options.sync_line)

    @property
    def command_port(self) -> int | None:
        """UDP port of the motion-capture server; None without a server."""
        return None if self._server is None else self._server.command_port

    def command(self, line: str) -> dict[str, object] | None:
        """Run one command; return the result of ``status``, otherwise None.

        Raises
        ------
        BadCommand
            The command, motion, sensor or argument is unknown.
        """
        verb, _, rest = line.strip().partition(" ")
        if verb == "status":
            return self.status()
        if verb not in self._verbs:
            raise InvalidCommandError(
                f"no command {verb!r}; there are: {', '.join(self._verbs)}, status"
            )
        try:
            self._verbs[verb](rest.strip())
        except UnknownMotionError as error:
            raise InvalidCommandError(str(error)) from error
        return None

    def _play(self, name: str) -> None:
        self._player.play(name)

    def _reboot(self, name: str) -> None:
        if name == OPTICAL:
            self._restart_server(clock_anew=True)
        else:
            self._stream(name).device.power_cycle()

    def _slip(self, words: str) -> None:
        stream, degrees = self._with_number(words, "slip S1 15 (degrees)")
        stream.faults.slip(math.radians(degrees))

    def _drift(self, words: str) -> None:
        stream, degrees = self._with_number(words, "drift S1 5 (degrees a minute)")
        stream.faults.drift(math.radians(degrees) / 60.0)

    def _with_number(self, words: str, example: str) -> tuple[ImuStream, float]:
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
            self._restart_server(clock_anew=False)
        else:
            self._optical.running = _on(word)

    def _restart_server(self, *, clock_anew: bool) -> None:
        """Close the server and reopen it after `DOWN_S`; reset its clock if `clock_anew`."""
        server = self._server
        if server is None:
            raise InvalidCommandError("there is no motion-capture server")
        server.unplug()
        if clock_anew:
            self._tickers[OPTICAL].reboot(time.monotonic_ns())
        asyncio.get_running_loop().call_later(DOWN_S, server.restart)

    def _stream(self, name: str) -> ImuStream:
        try:
            return self._hardware.streams[name]
        except KeyError:
            known = ", ".join(self._hardware.streams)
            raise InvalidCommandError(f"no sensor {name!r}; there are: {known}") from None

    def _plugs(self, name: str) -> tuple[Callable[[], None], Callable[[], None]]:
        found = self._hardware.bus if name == "can0" and self._hardware.bus else self._stream(name)
        return found.unplug, found.plug

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
        """Return the total numbers of samples sent, dropped, refused and unheard."""
        streams = self._hardware.streams
        return {
            "sent": {**{n: s.device.sent for n, s in streams.items()}, "mocap": self._optical.sent},
            "dropped_out": {n: s.dropped_out for n, s in streams.items()},
            "refused": {n: s.refused for n, s in streams.items()},
            "unheard": {n: s.unheard for n, s in streams.items()},
        }


def _check_clocks(asked: Mapping[str, ClockFault], known: tuple[str, ...]) -> None:
    for name in asked:
        if name not in known:
            raise InvalidCommandError(f"no clock {name!r}; there are: {', '.join(known)}")


def _on(word: str) -> bool:
    words = {"on": True, "start": True, "off": False, "stop": False}
    if word not in words:
        raise InvalidCommandError(f"{word!r}: expected {' or '.join(words)}")
    return words[word]
