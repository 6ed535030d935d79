"""CPU time of a running daemon by part of the program, sampled with py-spy.

A sample of py-spy is assigned to the innermost function of the project on the stack. Time in NumPy,
orjson or the system is therefore assigned to the function that calls it. A sample without any
function of the project is assigned to the event loop.
"""

from __future__ import annotations

import asyncio
import re
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from bench.experiments.speed.gateway import played
from bench.framework.measurement import speed_experiment, timed_result
from bench.rigs.gateway import Load, cpu_s, running_gateway

if TYPE_CHECKING:
    from collections.abc import Iterable

    from bench.framework.experiment import Result

RATE_HZ = 200.0
SECONDS, QUICK_S = 30, 5
SAMPLES_HZ = 100
_FRAME = re.compile(r"\((\S+?)(?::\d+)?\)$")
"""Pattern of the file name of a function in a py-spy stack, relative to the packages."""
PARTS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("ports: reading of serial ports, CAN and sockets", (
        "jointfit_drivers/ports/", "jointfit_drivers/can_", "jointfit_protocols/can/",
        "jointfit_drivers/motion_capture/_socket_link", "jointfit_drivers/motion_capture/_server",
        "jointfit_drivers/natnet/_link", "jointfit_drivers/natnet/_session",
    )),
    ("camera frames: codec and decoder", (
        "jointfit_protocols/natnet/", "jointfit_drivers/natnet/",
        "jointfit_drivers/motion_capture/",
    )),
    ("IMU samples: codecs and decoders", ("jointfit_protocols/", "jointfit_drivers/")),
    ("clocks", ("jointfit_daemon/timing/clock/", "jointfit_daemon/pipeline/sources/_source_state")),
    ("alignment", ("jointfit_daemon/timing/alignment/", "jointfit_daemon/pipeline/_frame_grid")),
    ("cameras in the core: lag, labels, origin, comparison, online learning", (
        "jointfit_daemon/timing/lag/", "jointfit_daemon/pipeline/sources/",
        "jointfit_daemon/pipeline/_label", "jointfit_daemon/limb_model/_label",
        "jointfit_daemon/limb_model/_rigid", "jointfit_daemon/limb_model/_marker",
        "jointfit_daemon/pipeline/_optical", "jointfit_daemon/pipeline/_mocap",
        "jointfit_daemon/pipeline/online_learning/", "jointfit_daemon/fusion/_optical",
        "jointfit_daemon/fusion/_cluster_pose", "jointfit_daemon/fusion/_rotation_fit",
    )),
    ("fusion", (
        "jointfit_daemon/fusion/", "jointfit_daemon/limb_model/", "jointfit_daemon/kinematics/",
    )),
    ("encoding", ("jointfit_daemon/outputs/payloads/",)),
    ("queue, MQTT and socket", ("jointfit_daemon/outputs/mqtt/",)),
    ("core and supervisor: distribution of events, health", ("jointfit_daemon/",)),
)  # fmt: skip
"""Parts of the program, each with the prefixes of its files. A file belongs to the first part that
matches."""
LOOP = "event loop: asyncio, aiomqtt and waiting for events"


def part_of(stack: Iterable[str]) -> str:
    """Return the part to which a py-spy stack belongs; the outermost function is first."""
    for function in reversed([*stack]):
        found = _FRAME.search(function)
        path = "" if found is None else found.group(1)
        if path.endswith("jointfit_daemon/__main__.py"):
            break  # this function calls the event loop
        for part, beginnings in PARTS:
            if any(beginning in path for beginning in beginnings):
                return part
    return LOOP


def shares(text: str) -> dict[str, float]:
    """Return the share of each part in the output of ``py-spy record --format raw``."""
    counts: Counter[str] = Counter()
    for line in text.splitlines():
        stack, _, count = line.rpartition(" ")
        counts[part_of(stack.split(";"))] += int(count)
    total = counts.total()
    return {part: count / total for part, count in counts.most_common()}


async def _profile(folder: Path, port: int, seconds: int) -> tuple[dict[str, float], float]:
    """Return the shares of the parts, and the CPU time of a frame, s."""
    written = folder / "stacks"
    async with running_gateway(folder, port, Load(RATE_HZ)) as gateway:
        frames, spent_s = len(gateway.heard.latencies_ms), cpu_s(gateway.pid)
        words = (
            "record", "--pid", str(gateway.pid), "--duration", str(seconds), "--nonblocking",
            "--rate", str(SAMPLES_HZ), "--format", "raw", "--output", str(written),
        )  # fmt: skip
        process = await asyncio.create_subprocess_exec(
            _sampler() or "py-spy", *words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        if await process.wait():
            raise RuntimeError(f"py-spy ended with {process.returncode}: run it as root")
        frames = len(gateway.heard.latencies_ms) - frames
        spent_s = cpu_s(gateway.pid) - spent_s
    return shares(written.read_text(encoding="utf-8")), spent_s / frames


def _sampler() -> str | None:
    beside = Path(sys.executable).parent
    return shutil.which("py-spy", path=str(beside)) or shutil.which("py-spy")


def rows(quick: bool) -> list[Result]:
    """Return the share of each part, and the CPU time of a frame; nothing without py-spy."""
    if _sampler() is None:
        print(
            "live-profile: not run: py-spy is not installed (pip install py-spy)", file=sys.stderr
        )
        return []
    seconds = QUICK_S if quick else SECONDS
    profile = played("mosquitto", lambda folder, port: _profile(folder, port, seconds))
    if profile is None:
        return []
    found, frame_s = profile
    return [
        timed_result("CPU time of a frame, sampler included", round(1e6 * frame_s), "µs"),
        *(
            timed_result(part, round(100.0 * share, 1), "%", note=f"{1e6 * share * frame_s:.0f} µs")
            for part, share in found.items()
        ),
    ]


EXPERIMENTS = (speed_experiment("live-profile", "CPU time of the running daemon by part", rows),)
