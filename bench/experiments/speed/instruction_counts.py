"""Interpreted instructions of a frame in each part of the daemon, independent of machine load.

Only bytecode instructions in Python functions of the project are counted. The counts are equal on
every machine and at any load. In contrast to the measured times, they do not include work in NumPy
or other C code.
"""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING
from unittest.mock import patch

from bench.experiments.speed import codec_natnet, codecs, core
from bench.framework.experiment import Experiment, Result
from bench.framework.material import THIS_MACHINE
from bench.subjects.simulated_wearer import bench_rig
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import Configured

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType
    from typing import Any

ROOT = f"{Path(__file__).resolve().parents[3]}/"
PYTHON = (3, 11)
"""Version of Python whose bytecode is counted."""
GROWTH = 1.1
"""Threshold for the ratio of a count to its value in `KNOWN`. After an intended growth or a large
reduction, `KNOWN` is updated."""
KNOWN = {
    "xbus: codec, one message": 157.0,
    "xbus: bytes to SI sample": 1089.9,
    "slcan: codec, one CAN frame": 213.0,
    "xcdi: 3 CAN frames to SI sample": 1213.2,
    "natnet: codec, one frame": 1967.0,
    "natnet: bytes to MocapFrame": 3362.5,
    "clock: one sample": 880.4,
    "aligner: one sample": 792.5,
    "core: 4 × 100 Hz, not calibrated, one frame": 14721.9,
}
"""Reference number of instructions per item, by part."""


def count_instructions(work: Callable[[], object]) -> int:
    """Return the number of instructions that `work` executes in functions of the project."""
    count = 0

    def trace(frame: FrameType, event: str, argument: Any) -> Any:  # noqa: ARG001 - for settrace
        nonlocal count
        if event == "call":
            if not frame.f_code.co_filename.startswith(ROOT):
                return None
            frame.f_trace_opcodes, frame.f_trace_lines = True, False
        elif event == "opcode":
            count += 1
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        work()
    finally:
        sys.settrace(before)
    return count


def _per_item(
    name: str, prepare: Callable[[], Callable[[], object]], *, items: int, **_: Any
) -> Result:
    """Return the instructions per item; this function replaces `per_item`, which measures time."""
    prepare()()  # fill the caches first
    count = count_instructions(prepare()) / items
    return Result(name, round(count, 1), round(GROWTH * KNOWN[name], 1), unit="instructions")


def _core_frames(seconds: float) -> Result:
    """Return the instructions of a frame of four sensors without a calibration."""
    stream = core.events(100.0, seconds)

    def prepare() -> Callable[[], object]:
        fresh = Core()
        fresh.feed(Configured(core.START_NS, bench_rig(), None))
        return lambda: [fresh.feed(event) for event in stream]

    frames = round(100 * seconds)
    return _per_item("core: 4 × 100 Hz, not calibrated, one frame", prepare, items=frames)


def counted_rows() -> list[Result]:
    """Return the counts of all parts; nothing with another version of Python."""
    if sys.version_info[:2] != PYTHON:
        print("instruction-counts: only on Python 3.11, whose bytecode is counted", file=sys.stderr)
        return []
    with ExitStack() as patches:
        for module in (codecs, codec_natnet, core):
            patches.enter_context(patch.object(module, "per_item", _per_item))
        parts = (
            codecs.xbus_rows, codecs.xcdi_rows, codec_natnet.own_rows,
            core.clock_rows, core.align_rows,
        )  # fmt: skip
        rows = [row for part in parts for row in part(True)]
    return [*rows, _core_frames(1.0)]


EXPERIMENTS = (
    Experiment(
        "instruction-counts",
        "Interpreted instructions of the frame's path",
        lambda _: counted_rows(),
        THIS_MACHINE,
    ),
)
