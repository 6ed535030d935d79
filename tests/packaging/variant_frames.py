"""Print the variant of this process, then all outputs of a core for four sensors and cameras.

This is a separate program, because the variant of a process does not change after its first import.
"""

from __future__ import annotations

from bench.experiments.speed.core import START_NS, worn
from bench.subjects.camera_session import session_events
from jointfit_daemon.model import LimbState
from jointfit_daemon.outputs.payloads import encode_pose
from jointfit_daemon.pipeline import Core
from jointfit_variant import running_variant

SECONDS = 14.0
"""Duration of the run, s. It suffices for one estimate of the lag of every sensor."""
SILENT = ("S2", 3.0, 4.0)
"""Sensor without data, and begin and end of the gap, s."""


def main() -> None:
    """Run a core and print every output in a line."""
    print(running_variant())
    core = Core()
    print(worn().to_dict())
    for event in session_events(SECONDS, silent=SILENT):
        for output in core.feed(event):
            if isinstance(output, LimbState):
                print(encode_pose(output, START_NS, 2 * START_NS))
            else:
                print(repr(output))
        print(core.next_deadline_ns)
    print(core.health(START_NS + round(SECONDS * 1e9)))


if __name__ == "__main__":
    main()
