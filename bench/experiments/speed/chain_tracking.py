"""Inverse kinematics of a chain model in the daemon: CPU time of a camera frame.

The results are the mean time of a frame, and the time of the slowest frame with healthy and with
faulty markers. For the slowest frame, the time of each frame is the minimum over the repeats, so
other processes hardly affect it.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from bench.framework.measurement import cpu_s, per_item, speed_experiment, timed_result
from jointfit_daemon.files.mocap import read_marker_trial
from jointfit_daemon.files.models import LoadedModel, load_model
from jointfit_daemon.kinematics.chain_coordinates import default_coordinates
from jointfit_daemon.kinematics.chains import ChainModel, ChainState, marker_positions
from jointfit_daemon.kinematics.inverse_kinematics import solve_frames
from jointfit_daemon.model import MocapFrame, MocapLayout
from jointfit_daemon.pipeline.chain_tracking import ChainTracker
from jointfit_simulators.sample import write_sample

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from bench.framework.experiment import Result
    from jointfit_daemon.arrays import Array

RATE_HZ = 100
NOISE_M = 0.001
SECONDS = 2.5
FAULTY_FROM = RATE_HZ
"""Number of the frame at which the markers become faulty."""
_TURNS, _NO_BODIES = np.zeros((0, 4)), np.zeros((0, 3))


@cache
def _sample() -> tuple[LoadedModel, LoadedModel, tuple[str, ...], Array]:
    """Return the models of the sample data, and noisy markers of walking at 100 Hz."""
    with TemporaryDirectory(prefix="jointfit-bench-") as folder:
        path = Path(folder)
        write_sample(path)
        toml, osim = load_model(path / "leg.toml"), load_model(path / "leg.osim")
        trial = read_marker_trial(path / "walking.trc")
        names = trial.trajectories.names
        recorded, rate_hz = trial.points(names), trial.trajectories.rate_hz

    at = np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ * rate_hz
    before = np.minimum(at.astype(int), len(recorded) - 2)
    share = (at - before)[:, None, None]
    points = (1.0 - share) * recorded[before] + share * recorded[before + 1]
    return toml, osim, names, points + np.random.default_rng(0).normal(0, NOISE_M, points.shape)


@cache
def _both_legs() -> tuple[LoadedModel, tuple[str, ...], Array]:
    """Return a model with two equal legs on one pelvis, and its markers if both move alike."""
    loaded, _, names, points = _sample()
    leg = loaded.chain
    order = [names.index(name) for name in leg.marker_names]
    state = solve_frames(leg, points[:, order]).state
    pelvis, *own = leg.segments
    other = [
        replace(
            s,
            name=f"other {s.name}",
            parent=pelvis.name if s.parent == pelvis.name else f"other {s.parent}",
        )
        for s in own
    ]
    hip = other[0].joint
    x, y, z = hip.center_in_parent
    other[0] = replace(other[0], joint=replace(hip, center_in_parent=(x - 0.18, y, z)))
    markers = [
        replace(m, name=f"other {m.name}", segment=f"other {m.segment}")
        for m in leg.markers
        if m.segment != pelvis.name
    ]
    model = ChainModel((*leg.segments, *other), (*leg.markers, *markers), "both legs")

    rotations = np.concatenate((state.rotations, state.rotations[:, 1:]), axis=1)
    both = marker_positions(model, ChainState(rotations, state.origins))
    both = both + np.random.default_rng(1).normal(0.0, NOISE_M, both.shape)
    return LoadedModel(model, default_coordinates(model)), model.marker_names, both


def _frames(names: tuple[str, ...], points: Array) -> list[MocapFrame]:
    layout = MocapLayout(names, ())
    return [MocapFrame(0, k, None, layout, row, _NO_BODIES, _TURNS) for k, row in enumerate(points)]


def _faulty(points: Array) -> Iterator[tuple[str, Array]]:
    """Yield the name of each fault, and the faulty markers."""
    kinds: dict[str, Callable[[Array], Array]] = {
        "two labels of a segment exchanged": lambda p: p[:, [1, 0, *range(2, p.shape[1])]],
        "all labels exchanged": lambda p: p[:, ::-1],
        "another size": lambda p: 1.5 * p,
        "a jump": lambda p: p @ np.diag([-1.0, -1.0, 1.0]) + (2.0, 1.0, 0.0),
        "all markers hidden": lambda p: np.where(np.arange(len(p))[:, None, None] < 50, np.nan, p),
        "last four markers hidden": lambda p: np.concatenate(
            (p[:, :-4], np.full_like(p[:, -4:], np.nan)), axis=1
        ),
    }
    for kind, change in kinds.items():
        yield kind, np.concatenate((points[:FAULTY_FROM], change(points[FAULTY_FROM:])))


def _track(model: LoadedModel, frames: list[MocapFrame]) -> Callable[[], object]:
    tracker = ChainTracker(model, RATE_HZ)
    period_ns = round(1e9 / RATE_HZ)
    tracker.add_frame(0, frames[0])  # the first frame has no previous frame

    def run() -> None:
        for k, frame in enumerate(frames[1:], start=1):
            tracker.add_frame(k * period_ns, frame)

    return run


def _worst_us(model: LoadedModel, frames: list[MocapFrame], repeats: int) -> float:
    """Return the CPU time of the slowest frame, µs; each frame is the minimum of its repeats."""
    least = np.full(len(frames), np.inf)
    for _ in range(repeats):
        tracker = ChainTracker(model, RATE_HZ)
        for k, frame in enumerate(frames):
            due = partial(tracker.add_frame, k * round(1e9 / RATE_HZ), frame)
            least[k] = min(least[k], cpu_s(due))
    return round(1e6 * float(least.max()), 1)


def rows(quick: bool) -> list[Result]:
    toml, osim, names, points = _sample()
    legs, leg_names, both = _both_legs()
    leg_note, legs_note = "4 segments, 16 markers, 100 Hz", "7 segments, 28 markers, 100 Hz"
    cases = [
        ("TOML, default coordinates", toml, names, points, 700, leg_note),
        ("OpenSim, coordinates of the file", osim, names, points, 700, leg_note),
        ("both legs", legs, leg_names, both, 1200, legs_note),
    ]
    found = [
        per_item(
            f"chain model: one camera frame, {name}",
            partial(_track, model, _frames(labels, y)),
            items=len(y) - 1,
            goal_us=goal_us,
            quick=quick,
            note=note,
        )
        for name, model, labels, y, goal_us, note in cases
    ]
    for limb, model, labels, y, note in (
        ("leg", toml, names, points, leg_note),
        ("both legs", legs, leg_names, both, legs_note),
    ):
        for kind, changed in (("healthy", y), *_faulty(y)):
            worst = _worst_us(model, _frames(labels, changed), 2 if quick else 3)
            name = f"chain model: slowest frame, {limb}, {kind}"
            found.append(timed_result(name, worst, "µs", 5000, 20000, note=note))
    return found


EXPERIMENTS = (
    speed_experiment(
        "chain-tracking-time", "Inverse kinematics of a chain model in the daemon", rows
    ),
)
