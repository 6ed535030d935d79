"""Errors of running joint centers of simulated legs, compared with the published covariance."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest

from bench.subjects.simulated_wearer import bench_rig
from jointfit_daemon.calibration import OpticalTrack
from jointfit_daemon.calibration.anatomy import static_cluster, track_clusters
from jointfit_daemon.limb_model import cluster_record
from jointfit_daemon.model import MocapFrame, MocapLayout
from jointfit_daemon.pipeline import MovingCenters
from jointfit_simulators.body import SimulatedSubject, Step
from jointfit_simulators.devices import Cameras
from jointfit_simulators.settings import Knobs
from tests.limb_model.plain_calibration import plain_calibration

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import RunningCenter

ABOVE = {"hip": "pelvis", "knee": "thigh", "ankle": "shank"}
PARTS = ("pelvis", "thigh", "shank", "foot")
SEEDS = range(1, 9)
CAMERAS_HZ, STAND_S, WALK_S = 20.0, 6.0, 32.0
SETTLED_S, MEMORY_S = 12.0, 10.0


@cache
def walk(seed: int, tissue_mm: float) -> list[tuple[Array, RunningCenter]]:
    """Return the true and the running centers of a walking leg, after the first seconds."""
    knobs = Knobs(seed=seed, mocap_hz=CAMERAS_HZ, marker_soft_tissue_mm=tissue_mm)
    subject = SimulatedSubject(knobs, [Step("stand", STAND_S), Step("walk", WALK_S)])
    t_s = np.arange(0.0, STAND_S + WALK_S, 1.0 / CAMERAS_HZ)
    cameras = Cameras(knobs, subject, rate_hz=CAMERAS_HZ)
    seen = subject.observe([t_s[:1]] * 4, t_s, t_s)
    frames, stamps = cameras.capture(seen), np.round(t_s * 1e9).astype(np.int64)
    still = (t_s >= 2.0) & (t_s < STAND_S)
    standing = OpticalTrack(
        stamps[still], cameras.markers, frames.markers[still], cameras.bodies,
        frames.body_positions[still], frames.body_orientations[still],
    )  # fmt: skip

    # The calibration has the marker clusters of the static pose and no centers. All segments have
    # the axes of the static world.
    rig = bench_rig()
    clusters = {part: static_cluster(standing, part, rig.calibration) for part in PARTS}
    calibration = replace(
        plain_calibration(rig.chain),
        clusters={name: cluster_record(cluster) for name, cluster in clusters.items()},
    )
    tracks, true = track_clusters(standing, clusters), {}
    for joint, part in ABOVE.items():
        world = cameras.world.apply(seen.truth.joints[joint][still])
        static = np.nanmean(tracks[part].to_static(world[:, None])[:, 0], axis=0)
        true[joint] = static - tracks[part].origin

    running = MovingCenters(rig.chain, calibration, MEMORY_S)
    layout = MocapLayout(cameras.markers, cameras.bodies)
    return [
        (true[one.joint], one)
        for k in np.flatnonzero(t_s >= STAND_S).tolist()
        for found in running.add_frame(
            int(stamps[k]),
            MocapFrame(
                int(stamps[k]), k, None, layout, frames.markers[k],
                frames.body_positions[k], frames.body_orientations[k],
            ),
        )
        for one in found.joints
        if t_s[k] >= STAND_S + SETTLED_S and one.center is not None
    ]  # fmt: skip


def squared_error(true: Array, one: RunningCenter) -> float:
    """Return the squared Mahalanobis distance per observed direction."""
    hidden = np.reshape(one.unseen, (-1, 3))
    observed = np.linalg.svd(hidden, full_matrices=True)[2][len(hidden) :]
    error = observed @ (np.array(one.center) - true)
    covariance = observed @ np.array(one.covariance) @ observed.T
    return float(error @ np.linalg.solve(covariance, error)) / len(observed)


@pytest.mark.parametrize("tissue_mm", [0.0, 5.0])
@pytest.mark.parametrize("joint", list(ABOVE))
def test_errors_of_running_centers_agree_with_their_covariance(
    joint: str, tissue_mm: float
) -> None:
    squares = [
        np.mean(
            [squared_error(true, one) for true, one in walk(seed, tissue_mm) if one.joint == joint]
        )
        for seed in SEEDS
    ]
    assert 0.2 < np.mean(squares) < 3.0


@pytest.mark.parametrize("tissue_mm", [0.0, 5.0])
def test_the_axis_of_a_hinge_is_its_unobserved_direction(tissue_mm: float) -> None:
    found = [one for seed in SEEDS for _, one in walk(seed, tissue_mm)]
    for one in found:
        assert one.axis == (one.unseen[0] if len(one.unseen) == 1 else None)
        for direction in one.unseen:
            assert np.linalg.norm(direction) == pytest.approx(1.0)
            assert max(direction) == np.abs(direction).max()
    axes = [one.axis for one in found if one.joint == "knee"]
    assert np.mean([axis is not None for axis in axes]) > 0.9
