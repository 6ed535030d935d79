"""CPU time of joint centers in the functional phase: per camera frame, and per progress report."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bench.framework.measurement import per_item, speed_experiment
from bench.subjects.simulated_wearer import bench_rig, phases
from jointfit_daemon.calibration.guidance import MovementGuide
from jointfit_daemon.model import MocapFrame, MocapLayout

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.framework.experiment import Result

FRAMES, LOOKS = 1200, 30
EVERY = 24
"""Number of frames between two progress reports: five reports per second at 120 Hz."""


def _frames() -> list[MocapFrame]:
    track = phases().functional.optical
    assert track is not None
    layout = MocapLayout(track.markers, track.bodies)
    seen = zip(track.positions, track.body_positions, track.body_orientations, strict=True)
    return [MocapFrame(0, i, None, layout, *arrays) for i, arrays in enumerate(seen)][:FRAMES]


def _guide() -> MovementGuide:
    rig = bench_rig()
    return MovementGuide(rig.chain, rig.calibration, phases().static)


def _feed(frames: list[MocapFrame]) -> Callable[[], object]:
    one = _guide()
    # After these frames, the estimators have converged.
    for i, frame in enumerate(frames[: 4 * EVERY]):
        one.add_mocap(frame)
        if i % EVERY == 0:
            one.update({}, 1.0)

    def run() -> None:
        for frame in frames:
            one.add_mocap(frame)

    return run


def _look(frames: list[MocapFrame]) -> Callable[[], object]:
    one = _guide()
    for frame in frames:
        one.add_mocap(frame)
    return lambda: [one.update({}, 10.0) for _ in range(LOOKS)]


def rows(quick: bool) -> list[Result]:
    frames = _frames()
    return [
        per_item(
            "live centers: one camera frame, 4 parts, 3 joints",
            lambda: _feed(frames),
            items=len(frames),
            goal_us=150,
            quick=quick,
            note="16 markers",
        ),
        per_item(
            "live centers: one estimate of one joint",
            lambda: _look(frames),
            items=LOOKS,
            goal_us=5000,
            quick=quick,
            note="five estimates per second",
        ),
    ]


EXPERIMENTS = (
    speed_experiment(
        "live-center-time",
        "Joint centres during the functional calibration",
        rows,
    ),
)
