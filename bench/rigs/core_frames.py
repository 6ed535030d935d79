"""Process that runs the core: ``python -m bench.rigs.core_frames CALIBRATION FRAMES``.

The core converts the bytes of four IMUs at 100 Hz to poses as JSON. An emulator counts the machine
instructions of the process. The start of every run has the same cost, so the difference between two
runs is the cost of the additional frames. `CALIBRATION` is a file with a calibration of the
simulated subject, because a fit would take long in the emulator.
"""

from __future__ import annotations

import gc
import json
import sys
from pathlib import Path

from bench.experiments.speed.core import START_NS, events
from bench.subjects.simulated_wearer import bench_rig
from jointfit_daemon.limb_model import Calibration
from jointfit_daemon.model import LimbState
from jointfit_daemon.outputs.payloads import encode_pose
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import Configured
from jointfit_daemon.units import NS_PER_S

RATE_HZ = 100.0
PREPARED_S = 20.0
"""Duration of the prepared bytes, s, the same in every run."""


def main(calibration: str, frames: str) -> None:
    """Compute the given number of frames."""
    stored = Calibration.from_dict(json.loads(Path(calibration).read_text(encoding="utf-8")))
    stream = events(RATE_HZ, PREPARED_S)
    core = Core()
    core.feed(Configured(START_NS, bench_rig(RATE_HZ), stored, 1))
    gc.collect()
    gc.disable()
    left = int(frames)
    for event in stream:
        outputs = core.feed(event)
        _ = core.next_deadline_ns  # the runner reads the deadline after every event
        for output in outputs:
            if isinstance(output, LimbState):
                encode_pose(output, NS_PER_S, 2 * NS_PER_S)
                left -= 1
        if left <= 0:
            return
    raise SystemExit(f"{frames} frames: expected at most {round(RATE_HZ * PREPARED_S)}")


if __name__ == "__main__":
    main(*sys.argv[1:])
