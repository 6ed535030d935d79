"""Markers that moved after the static pose: refinement, evaluation and reports."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from jointfit_daemon.calibration import FunctionalJob
from jointfit_daemon.calibration.anatomy import track_clusters
from jointfit_daemon.calibration.phases import StaticPose, fit_static, run_job
from jointfit_daemon.calibration.phases._cluster_refinement import RefinedClusters, refine_clusters
from jointfit_daemon.calibration.phases._functional import refined_tracks
from jointfit_daemon.limb_model import Calibration, cluster_record
from jointfit_daemon.outputs.payloads._quality_units import quality_payload
from jointfit_daemon.tools.calibrate._report import report
from tests.calibration.synthetic_limb import (
    CHAIN,
    MARKERS,
    SETTINGS,
    Imperfections,
    Motion,
    Subject,
    motion,
    record,
    static_and_functional,
)

if TYPE_CHECKING:
    from jointfit_daemon.calibration import CalibrationTrial, OpticalTrack
    from jointfit_daemon.limb_model import MarkerCluster

KNOCKED, KNOCK = "thigh1", np.array([0.011, -0.009, 0.006])
WORN = Subject(5, flaws=Imperfections(sensor_deg=0.3, tissue_deg=3.0, skin_m=0.002, occluded=0.03))


@cache
def trials() -> tuple[CalibrationTrial, CalibrationTrial, Motion]:
    """Return a static pose, a movement with one displaced marker, and the true motion."""
    static, functional, moving = static_and_functional(WORN, 24.0)
    optical = functional.optical
    assert optical is not None
    positions = optical.positions.copy()
    positions[:, optical.markers.index(KNOCKED)] += bones(moving, optical).apply(KNOCK)
    return static, replace(functional, optical=replace(optical, positions=positions)), moving


def bones(moving: Motion, optical: OpticalTrack) -> Rotation:
    return Slerp(moving.t_s, moving.q["thigh"])(optical.t_ns * 1e-9)


def optical_of(trial: CalibrationTrial) -> OpticalTrack:
    assert trial.optical is not None
    return trial.optical


@cache
def pose() -> StaticPose:
    return fit_static(trials()[0], SETTINGS, CHAIN)


@cache
def refined() -> RefinedClusters:
    tracks = track_clusters(optical_of(trials()[1]), pose().clusters)
    return refine_clusters(pose().clusters, tracks, 0.4)


def bias_deg(cluster: MarkerCluster) -> float:
    """Return the mean error of the thigh's orientation relative to the static pose, deg."""
    _, functional, moving = trials()
    optical = optical_of(functional)
    q = track_clusters(optical, {"thigh": cluster})["thigh"].q
    seen = np.flatnonzero(np.isfinite(q).all(axis=1))
    standing = motion(WORN, 6.0, 400.0, still=True).q["thigh"][0]
    turned = bones(moving, optical)[seen] * standing.inv()
    off = (turned.inv() * Rotation.from_quat(q[seen], scalar_first=True)).as_rotvec()
    return float(np.degrees(np.linalg.norm(off.mean(axis=0))))


def test_a_displaced_marker_is_found_and_rotates_its_segment_less() -> None:
    found = refined()
    assert found.figures is not None
    moved = found.figures.moved_m
    assert max(moved, key=lambda name: moved[name]) == KNOCKED
    assert moved[KNOCKED] == pytest.approx(np.linalg.norm(KNOCK), abs=0.005)
    assert bias_deg(found.clusters["thigh"]) < 0.6 * bias_deg(pose().clusters["thigh"])


def test_the_error_decreases_on_the_held_out_part() -> None:
    found = refined()
    assert found.figures is not None
    parts = found.figures.parts
    assert set(parts) == set(MARKERS)
    assert parts["thigh"].refined
    assert parts["thigh"].after_m < 0.6 * parts["thigh"].before_m
    assert all(part.after_m < part.before_m for part in parts.values() if part.refined)
    assert found.notes == ()


def test_refinement_hardly_changes_markers_that_did_not_move() -> None:
    subject = Subject(6)  # its markers have a noise of 0.5 mm and are not displaced
    static, functional, _ = static_and_functional(subject, 18.0)
    clusters = fit_static(static, SETTINGS, CHAIN).clusters
    found = refine_clusters(clusters, track_clusters(optical_of(functional), clusters), 0.4)
    assert found.figures is not None
    assert max(found.figures.moved_m.values(), default=0.0) < 0.001
    for name, cluster in clusters.items():
        used = found.clusters[name]
        np.testing.assert_allclose(used.template.mean(axis=0), 0.0, atol=1e-12)
        np.testing.assert_allclose(used.origin, cluster.origin, atol=0.001)


def test_a_part_is_unchanged_if_its_held_out_error_does_not_decrease() -> None:
    functional = trials()[1]
    optical = optical_of(functional)
    cut = round(0.6 * len(optical.t_ns))
    moving = bones(trials()[2], optical)[:cut]
    positions = optical.positions.copy()
    # the marker is displaced in the training part, and not displaced in the held-out part
    positions[cut:, optical.markers.index(KNOCKED)] -= bones(trials()[2], optical)[cut:].apply(
        KNOCK
    )
    assert len(moving) == cut
    tracks = track_clusters(replace(optical, positions=positions), pose().clusters)
    found = refine_clusters(pose().clusters, tracks, 0.4)
    assert found.figures is not None
    assert not found.figures.parts["thigh"].refined
    assert found.clusters["thigh"] is pose().clusters["thigh"]
    assert KNOCKED not in found.figures.moved_m


def test_marker_occluded_during_movement_keeps_its_position() -> None:
    optical = optical_of(trials()[1])
    positions = optical.positions.copy()
    positions[:, optical.markers.index("shank2")] = np.nan
    tracks = track_clusters(replace(optical, positions=positions), pose().clusters)
    found = refine_clusters(pose().clusters, tracks, 0.4)
    assert found.figures is not None
    assert found.figures.moved_m.get("shank2", 0.0) < 0.004
    assert np.isfinite(found.clusters["shank"].template).all()


@pytest.mark.parametrize(
    ("one", "other", "said"),
    [("pelvis0", "pelvis1", "look exchanged"), ("foot0", "foot2", "foot: markers not refined: ")],
)
def test_exchanged_labels_are_reported_and_their_cluster_is_not_refined(
    one: str, other: str, said: str
) -> None:
    part = one[:-1]
    tracks = track_clusters(optical_of(trials()[1]), pose().clusters)
    i, j = MARKERS[part].index(one), MARKERS[part].index(other)
    points = tracks[part].points.copy()
    points[:, [i, j]] = points[:, [j, i]]
    wrong = {**tracks, part: replace(tracks[part], points=points)}
    found = refine_clusters(pose().clusters, wrong, 0.4)
    assert found.clusters[part] is pose().clusters[part]
    assert said in found.notes[0]


def test_refinement_of_rigid_bodies_reports_that_markers_are_missing() -> None:
    bodies = {
        name: replace(c, body=name.title(), markers=()) for name, c in pose().clusters.items()
    }
    tracks = track_clusters(optical_of(trials()[1]), pose().clusters)
    found = refine_clusters(bodies, tracks, 0.4)
    assert found.clusters is bodies
    assert found.figures is None
    assert "rigid bodies" in found.notes[0]


@pytest.mark.timeout(90)
def test_worker_stores_and_reports_the_result_of_refinement() -> None:
    static, functional, _ = trials()
    job = FunctionalJob(CHAIN, replace(SETTINGS, method="mean"), static, functional)
    result = run_job(job).to_dict()
    figures = json.loads(json.dumps(result["quality"]["markers"], allow_nan=False))
    assert figures["parts"]["thigh"]["after_m"] < figures["parts"]["thigh"]["before_m"]
    stored = Calibration.from_dict(result["calibration"])
    assert stored.quality["markers"] == result["quality"]["markers"]
    assert stored.clusters["thigh"] == cluster_record(refined().clusters["thigh"])
    lines = report(quality_payload(stored.quality))
    assert any(
        line.startswith("thigh: RMS marker error ") and "after refinement" in line for line in lines
    )
    assert any(line.startswith(f"{KNOCKED}: ") and "check the marker" in line for line in lines)


def test_without_refinement_markers_and_tracks_are_unchanged() -> None:
    tracks = track_clusters(optical_of(trials()[1]), pose().clusters)
    plain = replace(SETTINGS, refine_markers=False)
    found, same = refined_tracks(tracks, pose(), trials()[1], plain)
    assert same is tracks
    assert found == RefinedClusters(pose().clusters, None)


def test_a_new_pose_fits_the_refined_markers() -> None:
    again = record(WORN, motion(WORN, 6.0, 400.0, still=True), 4)
    optical = optical_of(again)
    standing = motion(WORN, 6.0, 400.0, still=True).q["thigh"][0]
    positions = optical.positions.copy()
    positions[:, optical.markers.index(KNOCKED)] += standing.apply(KNOCK)
    knocked = replace(again, optical=replace(optical, positions=positions))
    new = fit_static(knocked, SETTINGS, CHAIN).clusters["thigh"]
    old, used = pose().clusters["thigh"], refined().clusters["thigh"]

    def off(cluster: MarkerCluster) -> float:
        seen, _ = Rotation.align_vectors(new.template, cluster.template)
        return float(np.degrees(seen.magnitude()))

    assert off(used) < off(old)
