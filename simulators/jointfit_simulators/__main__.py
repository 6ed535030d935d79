"""Command-line interface of the hardware simulator, ``jointfit-sim``.

The command ``jointfit-sim play --directory DIR`` reads one command per line from stdin: ``play
NAME``, ``unplug ID``, ``plug ID``, ``reboot ID``, ``stick ID``, ``free ID``, ``slip ID DEG``,
``drift ID DEG``, ``occlude on|off``, ``hide MARKER``, ``show MARKER``, ``exchange MARKER MARKER``,
``mocap stop|start|restart``, ``pause on|off``, ``status``, ``quit``. ID is a sensor, or ``can0``
for the bus adapter; ``reboot`` also accepts ``mocap``. The option ``--at SECONDS=COMMAND``
schedules a command. The simulator continues after the end of stdin. SIGTERM and SIGINT stop the
simulator.

Invariant: stdout contains JSON lines only. One line reports that all devices are ready. Each
command ``status`` yields a line, each invalid command yields ``{"error": …}``, and each motion
started by ``--follow`` yields ``{"motion": …}``. The last line contains the numbers of sent
samples.
"""

from __future__ import annotations

import argparse
import asyncio
import dataclasses
import math
import os
import selectors
import signal
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import orjson

from jointfit_simulators.body import (
    LIMBS,
    SENSORS,
    RecordedSubject,
    SimulatedSubject,
    UnknownMotionError,
    parse_motion_script,
    read_recorded_trial,
)
from jointfit_simulators.devices import ClockFault
from jointfit_simulators.recorded import RecordedScene, read_session_chunks
from jointfit_simulators.sample import write_sample
from jointfit_simulators.scene import (
    InvalidCommandError,
    PhaseFollower,
    RigOptions,
    Scene,
    SceneOptions,
    play_directory,
)
from jointfit_simulators.settings import Knobs, apply_settings, knobs_from_toml, perfect

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_simulators.body import InstrumentedSubject

USAGE = 2
"""Exit code for invalid options, files or ports."""
ORIGIN_NS = 100_000_000
"""The start time is a multiple of this time, ns, so that the samples of perfect clocks coincide
with the ground truth."""
_HIDDEN_S = 0.6
"""Time in which the cameras do not see the markers while the sensors are put on the plate, s. A new
motion begins at most 0.3 s after its command."""
_COMMAND_BYTES = 4096
"""Maximum length of a command line, bytes."""
_PERFECT = "no imperfections except clock offsets, minimum latencies, and the knobs set by --set"
"""Help text of ``--perfect``."""
COMMANDS = """commands, one per line on standard input:
  play NAME, play NAME at-once  change to another motion, with or without a blend
  unplug ID, plug ID          disconnect or connect a sensor, or the bus adapter (can0)
  reboot ID                   restart a sensor or mocap, and its clock
  stick ID, free ID           start or stop repeating the last sample of a sensor
  slip ID DEG                 rotate the sensor on the segment within 0.3 s
  drift ID DEG                heading drift in degrees per minute; 0 stops it
  occlude on, occlude off     hide all markers from the cameras, or show them
  hide MARKER, show MARKER    hide one marker from the cameras, or show it
  exchange MARKER MARKER      exchange the labels of two markers
  mocap stop, mocap start     stop or start the motion-capture stream
  mocap restart               close and reopen the server; its clock continues
  pause on, pause off         stop or start all transmission; time continues
  status                      print the numbers of samples sent, as JSON
  quit                        stop, and print the counts"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jointfit-sim",
        description="Simulate the sensors and cameras of a moving limb on real ports.",
        epilog="Exit codes: 0 stopped normally, 1 bug, 2 wrong options, files or ports.",
    )

    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("knobs", help="list every knob (setting) with its default")
    motions = commands.add_parser("motions", help="list every motion of a limb")
    motions.add_argument("--limb", choices=[*LIMBS], default="leg", help="default: leg")

    sample = commands.add_parser("sample", help="write sample trials, a model, captures and a rig")
    sample.add_argument("folder", type=Path, help="output folder; created if absent")
    sample.add_argument("--seed", type=int, default=1, help="random seed of the subject")
    sample.add_argument(
        "--force", action="store_true", help="write into a folder that is not empty"
    )

    play = commands.add_parser(
        "play", help="simulate in real time until stopped", epilog=COMMANDS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    _add_play_options(play)
    _add_hardware_options(play)
    return parser


def _add_play_options(play: argparse.ArgumentParser) -> None:
    play.add_argument("--directory", type=Path, required=True, help="output folder")
    play.add_argument("--limb", choices=[*LIMBS], default="leg",
                      help="leg: thigh and shank; legs: both legs with the pelvis; "
                      "arm: thorax to hand; trunk: thorax and pelvis (default leg)")  # fmt: skip
    play.add_argument(
        "--programme", help="NAME:SECONDS,…; the last motion continues (default stand)"
    )
    play.add_argument("--set", dest="settings", action="append", default=[], metavar="KNOB=VALUE")
    play.add_argument("--knobs", type=Path, help="TOML file of knobs")
    play.add_argument("--perfect", action="store_true", help=_PERFECT)
    play.add_argument("--rate", type=float, help="IMU samples per second")
    play.add_argument("--seed", type=int, help="random seed")
    play.add_argument("--command-port", type=int, metavar="PORT",
                      help="port of the motion-capture server (default: the port of the "
                      "previous run in this directory, otherwise any free port)")  # fmt: skip
    play.add_argument("--follow", action="store_true",
                      help="select the motion by the daemon's calibration phase: align, static, "
                      "functional (over MQTT, broker and base as in rig.toml)")  # fmt: skip
    play.add_argument("--motion", action="append", default=[], metavar="NAME=FILE",
                      help="add a motion of joint angles: .toml, .npz, .mot or .sto")  # fmt: skip
    play.add_argument("--clock", action="append", default=[], metavar="ID=PPM[,UP_S]",
                      help="skew and uptime of the clock of a sensor or mocap")  # fmt: skip
    play.add_argument("--at", action="append", default=[], metavar="SECONDS=COMMAND",
                      help="run a command this many seconds after the start")  # fmt: skip
    play.add_argument("--sync-line", action="store_true",
                      help="connect the cameras' sync output to every UART sensor")  # fmt: skip
    play.add_argument("--ptp", action="store_true",
                      help="send PTP precision timestamps with the camera frames")  # fmt: skip
    play.add_argument("--chain-model", action="store_true",
                      help="write leg.toml, a chain model of the subject, and name it in "
                      "rig.toml")  # fmt: skip
    play.add_argument("--planar", action="store_true",
                      help="cameras only, with markers rigid on the bones (one each on pelvis and "
                      "foot, two each on thigh and shank), for planar motion")  # fmt: skip
    play.add_argument("--sample-log", action="store_true",
                      help="write samples.jsonl with the true time of each sample")  # fmt: skip
    play.add_argument("--trial", type=Path, nargs="+", metavar="FILE",
                      help="replay a trial: .npz or .sto, with .trc and .json")  # fmt: skip

    play.add_argument("--recording", type=Path, metavar="FILE",
                      help="send a recording of the daemon once through virtual devices, at the "
                      "recorded intervals, and write their rig.toml; of the other options, "
                      "only --directory, --mqtt-host and --mqtt-port apply")  # fmt: skip

    for field in dataclasses.fields(RigOptions):
        play.add_argument(
            f"--{field.name.replace('_', '-')}",
            type=type(field.default),
            default=field.default,
            help=f"value written to rig.toml (default {field.default})",
        )


def _add_hardware_options(play: argparse.ArgumentParser) -> None:
    play.add_argument("--imu", action="append", default=[], metavar="ID=DRIVER",
                      help="driver of the IMU simulated for a sensor, such as S2=xbus; by default "
                      "xbus and xcdi in turn; xbus-mtdata is an older device of the driver "
                      "xbus")  # fmt: skip
    play.add_argument("--mocap", default="natnet", metavar="DRIVER",
                      help="driver of the motion-capture server (default natnet)")  # fmt: skip
    play.add_argument("--no-mocap", action="store_true", help="no optical system")
    play.add_argument("--can", default="slcan", help="slcan, or INTERFACE:CHANNEL of python-can")


def _knobs(options: argparse.Namespace) -> Knobs:
    knobs = knobs_from_toml(options.knobs) if options.knobs else Knobs()
    if options.perfect:
        knobs = perfect(knobs)
    if options.rate is not None and not 0.0 < options.rate < math.inf:
        raise ValueError(f"--rate {options.rate:g}: expected a number above 0, Hz")
    named = {"rate_hz": options.rate, "seed": options.seed}
    settings = [f"{name}={value}" for name, value in named.items() if value is not None]
    return apply_settings(knobs, settings + options.settings)


def _subject(options: argparse.Namespace, knobs: Knobs) -> InstrumentedSubject:
    steps = parse_motion_script(options.programme or "stand")
    if options.limb != "leg" and (options.trial or options.motion):
        raise ValueError(
            f"--limb {options.limb}: --trial and --motion contain angles of a leg: leave them out"
        )
    if options.trial:
        recording = read_recorded_trial(options.trial)
        return RecordedSubject(recording, SENSORS, steps, transition_s=knobs.transition_s)
    files = {name: Path(path) for name, path in _pairs("--motion", options.motion)}
    return SimulatedSubject(knobs, steps, motion_files=files, limb=options.limb)


def _pairs(option: str, words: Sequence[str]) -> list[tuple[str, str]]:
    """Return both parts of arguments ``A=B``; raise ValueError for other forms."""
    parts = [word.partition("=") for word in words]
    if wrong := [a for a, equals, _ in parts if not equals]:
        raise ValueError(f"{option} {wrong[0]}: expected two parts, A=B: see --help")
    return [(a, b) for a, _, b in parts]


def _clocks(words: Sequence[str]) -> dict[str, ClockFault]:
    """Return the clock faults from arguments of the form ``ID=PPM[,UP_S]``."""
    clocks = {}
    for name, text in _pairs("--clock", words):
        try:
            clocks[name] = ClockFault.parse(text)
        except ValueError as error:
            raise ValueError(
                f"--clock {name}={text}: expected numbers, PPM or PPM,UP_S, as in {name}=50"
            ) from error
    return clocks


def _schedule(words: Sequence[str]) -> tuple[tuple[float, str], ...]:
    """Return the scheduled commands from arguments of the form ``SECONDS=COMMAND``."""
    script = []
    for at_s, command in _pairs("--at", words):
        try:
            script.append((float(at_s), command))
        except ValueError as error:
            raise ValueError(
                f"--at {at_s}={command}: expected seconds before the command, as in 12.5=quit"
            ) from error
    return tuple(script)


def _print_json(line: dict[str, object]) -> None:
    text = orjson.dumps(line, option=orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_APPEND_NEWLINE)
    try:
        sys.stdout.buffer.write(text)
        sys.stdout.buffer.flush()
    except BrokenPipeError:  # continue without output if the pipe is closed
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


async def _run_commands(scene: Scene) -> None:
    """Run the commands from stdin until end of file."""
    reader = asyncio.StreamReader(limit=_COMMAND_BYTES)
    try:
        transport, _ = await asyncio.get_running_loop().connect_read_pipe(
            lambda: asyncio.StreamReaderProtocol(reader), sys.stdin
        )
    except (ValueError, OSError):  # a plain file or /dev/null is not read
        return

    try:
        while data := await reader.readline():
            line = data.decode(errors="replace").strip()
            try:
                answer = scene.command(line) if line else None
            except InvalidCommandError as error:
                answer = {"error": str(error)}
            if answer is not None:
                _print_json(answer)
    finally:
        transport.close()


async def _play_recording(options: argparse.Namespace) -> None:
    session = read_session_chunks(options.recording)
    with play_directory(options.directory.absolute()):
        broker = (options.mqtt_host, options.mqtt_port)
        scene = RecordedScene(session, options.directory.absolute(), broker)
        for number in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(number, scene.stop)
        await scene.run(_print_json)


async def _play(options: argparse.Namespace) -> None:
    if options.recording is not None:
        await _play_recording(options)
        return
    knobs = _knobs(options)
    rig = RigOptions(
        **{field.name: getattr(options, field.name) for field in dataclasses.fields(RigOptions)}
    )
    hardware = SceneOptions(
        options.directory.absolute(),
        mocap=None if options.no_mocap else options.mocap,
        wires=dict(_pairs("--imu", options.imu)),
        can=options.can,
        rig=rig,
        clocks=_clocks(options.clock),
        script=_schedule(options.at),
        sync_line=options.sync_line,
        ptp=options.ptp,
        chain_model=options.chain_model,
        planar=options.planar,
        sample_log=options.sample_log,
    )
    if options.follow and options.trial:
        raise ValueError("--follow needs the motions of the simulator: leave out --trial")
    if options.chain_model and (options.trial or options.no_mocap or options.limb != "leg"):
        raise ValueError("--chain-model is for the simulated leg and its markers: leave it out")
    if options.planar:
        if options.trial or options.no_mocap or options.limb != "leg" or options.chain_model:
            raise ValueError("--planar is for the simulated leg and its markers: leave it out")
        # Soft-tissue artefact would hide the arc of a single marker.
        knobs = dataclasses.replace(knobs, marker_soft_tissue_mm=0.0)
        options.programme = options.programme or "leg_swings"
    subject = _subject(options, knobs)

    with play_directory(hardware.directory) as directory:
        if hardware.mocap is not None:
            port = directory.command_port(options.command_port)
            hardware = dataclasses.replace(hardware, command_port=port)
        now_ns = time.monotonic_ns() // ORIGIN_NS * ORIGIN_NS
        scene = Scene(knobs, subject, hardware, now_ns=now_ns)
        directory.store_command_port(scene.command_port)
        await _run_scene(scene, rig if options.follow else None, options.limb)


async def _run_scene(scene: Scene, followed: RigOptions | None, limb: str) -> None:
    """Run a scene with the commands from stdin; follow the phases of a daemon if requested."""
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, scene.stop)

    def play(name: str) -> None:
        if name == "plate":  # the cameras must not see the transfer to the plate
            scene.command("occlude on")
            scene.command("play plate at-once")
            asyncio.get_running_loop().call_later(_HIDDEN_S, scene.command, "occlude off")
        else:
            scene.command(f"play {name}")
        _print_json({"motion": name})

    def report(text: str) -> None:
        print(f"jointfit-sim: {text}", file=sys.stderr, flush=True)

    async with asyncio.TaskGroup() as tasks:
        others = [tasks.create_task(_run_commands(scene), name="commands")]
        if followed is not None:
            follower = PhaseFollower(followed, play, report, limb)
            others.append(tasks.create_task(follower.run(), name="phase follower"))
        await scene.run(_print_json)
        for other in others:
            other.cancel()


def _select_loop() -> asyncio.AbstractEventLoop:
    """Return an event loop based on select, because epoll rounds timeouts up to milliseconds."""
    return asyncio.SelectorEventLoop(selectors.SelectSelector())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``jointfit-sim``; return its exit code."""
    options = _parser().parse_args(arguments)
    if options.command == "knobs":
        _print_json(dataclasses.asdict(Knobs()))
    elif options.command == "motions":
        _print_json({"motions": list(LIMBS[options.limb].motions)})
    else:
        try:
            if options.command == "sample":
                files = write_sample(options.folder, seed=options.seed, force=options.force)
                _print_json({"files": files})
                return 0
            with asyncio.Runner(loop_factory=_select_loop) as runner:
                runner.run(_play(options))
        except OSError as error:
            place = f"{error.filename}: " if error.filename else ""
            reason = error.strerror or error
            print(f"jointfit-sim: {place}{reason}: check the path", file=sys.stderr)
            return USAGE
        except (ValueError, UnknownMotionError) as error:
            print(f"jointfit-sim: {error}", file=sys.stderr)
            return USAGE
    return 0


if __name__ == "__main__":
    sys.exit(main())
