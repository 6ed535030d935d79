"""CPU time of lag tracking on the event loop: per sample, per second of data, and longest step."""

from __future__ import annotations

from functools import partial
from statistics import median
from typing import TYPE_CHECKING

import numpy as np

from bench.framework.measurement import cpu_s, loop_s, repeats, speed_experiment, timed_result
from bench.subjects.simulated_wearer import bench_rig, fitted, phases
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion
from jointfit_daemon.model import MocapFrame, MocapLayout
from jointfit_daemon.pipeline.sources import LagMonitor

if TYPE_CHECKING:
    from bench.framework.experiment import Result
    from jointfit_daemon.model import Quaternion

    Event = tuple[int, str, Quaternion | MocapFrame]

FRAMES = 120 * 14
"""Number of camera frames: 14 s, which contain a window of 10 s and the shift to the next window.
"""


def _events() -> list[Event]:
    """Return the sensor and camera samples of a moving subject, in order of time."""
    trial = phases().functional
    track = trial.optical
    assert track is not None
    layout = MocapLayout(track.markers, track.bodies)
    seen = zip(track.positions, track.body_positions, track.body_orientations, strict=True)
    stamps = track.t_ns[:FRAMES].tolist()
    found: list[Event] = [
        (t, "", MocapFrame(0, i, None, layout, *arrays))
        for i, (t, arrays) in enumerate(zip(stamps, seen, strict=False))
    ]
    for name, said in trial.sensors.items():
        now = said.t_ns <= stamps[-1]
        q_all = said.q_world_sensor[now].tolist()
        found += [
            (t, name, as_quaternion(q)) for t, q in zip(said.t_ns[now].tolist(), q_all, strict=True)
        ]
    return sorted(found, key=lambda event: event[0])


def _play(watch: LagMonitor, events: list[Event]) -> tuple[float, float, float]:
    """Return CPU times, s: per sample, of all steps for 1 s of data, and of the longest step."""
    adding, steps = 0.0, []
    for t_ns, sensor, said in events:
        if isinstance(said, MocapFrame):
            adding += cpu_s(partial(watch.add_mocap, t_ns, said))
            steps.append(cpu_s(partial(watch.step, t_ns)))
        else:
            adding += cpu_s(partial(watch.add_sample, sensor, t_ns, said))
    return adding / len(events), sum(steps) / (FRAMES / 120), float(np.max(steps))


def rows(quick: bool) -> list[Result]:
    events, rig = _events(), bench_rig()
    calibration = fitted(rig)
    tries = min(repeats(quick), 7)
    played = [_play(LagMonitor(rig.chain, calibration), events) for _ in range(tries)]
    add, second, most = (median(figures) for figures in zip(*played, strict=True))
    loop = loop_s()
    figures = (
        ("lag tracking: one sample or frame in", 1e6 * add, "µs", 5.0),
        ("lag tracking: all steps for 1 s of 4 sensors, 120 Hz cameras", 1e3 * second, "ms", 50.0),
        ("lag tracking: longest step", 1e3 * most, "ms", 8.0),
    )
    return [
        timed_result(
            name, round(figure, 3), unit, goal, 4 * goal, ratio=round(figure * scale / loop, 4)
        )
        for (name, figure, unit, goal), scale in zip(figures, (1e-6, 1e-3, 1e-3), strict=True)
    ]


EXPERIMENTS = (
    speed_experiment(
        "lag-tracking-time",
        "Lag estimation while running",
        rows,
    ),
)
