"""Recording of one phase: order in time, windows, and mocap layouts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.model import MocapFrame, MocapLayout
from jointfit_daemon.pipeline.calibration_session._trial_recorder import TrialRecorder

IDENTITY = (1.0, 0.0, 0.0, 0.0)


def frame(layout: MocapLayout, value: float) -> MocapFrame:
    return MocapFrame(
        arrival_ns=0,
        number=0,
        ticks=None,
        layout=layout,
        markers=np.full((len(layout.markers), 3), value),
        body_positions=np.full((len(layout.bodies), 3), value),
        body_orientations=np.tile(IDENTITY, (len(layout.bodies), 1)),
    )


@given(st.lists(st.integers(-1000, 1000), max_size=60))
def test_tracks_are_strictly_increasing_for_any_order_of_samples(times: list[int]) -> None:
    recorder = TrialRecorder()
    for t in times:
        recorder.add_sample("S1", t, IDENTITY)
    track = recorder.trial().sensors.get("S1")
    if track is None:
        assert not times
        return
    assert (np.diff(track.t_ns) > 0).all()
    assert track.t_ns[0] == times[0]
    assert track.t_ns[-1] == max(times)


def test_trial_can_be_limited_to_a_window() -> None:
    recorder = TrialRecorder()
    for t in range(10):
        recorder.add_sample("S1", t, IDENTITY)
        recorder.add_mocap(t, frame(MocapLayout(("A",), ()), t))
    trial = recorder.trial(3, 6)
    assert trial.sensors["S1"].t_ns.tolist() == [3, 4, 5, 6]
    assert trial.optical is not None
    assert trial.optical.positions[:, 0, 0].tolist() == [3, 4, 5, 6]


def test_marker_that_appears_later_is_nan_before() -> None:
    recorder = TrialRecorder()
    recorder.add_mocap(1, frame(MocapLayout(("A",), ("Body",)), 1.0))
    recorder.add_mocap(2, frame(MocapLayout(("B", "A"), ()), 2.0))
    optical = recorder.trial().optical
    assert optical is not None
    assert optical.markers == ("A", "B")
    assert np.isnan(optical.positions[0, 1]).all()
    assert (optical.positions[1] == 2.0).all()
    assert np.isnan(optical.body_orientations[1]).all()


def test_without_mocap_there_is_no_optical_track() -> None:
    recorder = TrialRecorder()
    recorder.add_sample("S1", 1, IDENTITY)
    assert recorder.trial().optical is None


def test_alternating_layouts_are_merged_by_name() -> None:
    one, other = MocapLayout(("a", "b"), ("T",)), MocapLayout(("c", "a"), ())
    recorder = TrialRecorder()
    for k in range(6):
        recorder.add_mocap(k, frame(one if k % 2 else other, float(k)))
    optical = recorder.trial().optical
    assert optical is not None
    assert optical.markers == ("c", "a", "b")
    for k in range(6):
        c, a, b = optical.positions[k, :, 0]
        assert a == k
        assert (np.isnan(c), b) == (True, k) if k % 2 else (c, np.isnan(b)) == (k, True)
        assert np.isnan(optical.body_positions[k]).all() == (k % 2 == 0)


def test_residuals_of_the_cameras_are_recorded_by_name_and_nan_where_a_frame_has_none() -> None:
    recorder = TrialRecorder()
    recorder.add_mocap(1, frame(MocapLayout(("A",), ()), 1.0))
    optical = recorder.trial().optical
    assert optical is not None
    assert optical.residuals is None
    measured = frame(MocapLayout(("B", "A"), ()), 2.0)
    recorder.add_mocap(2, replace(measured, residuals=np.array([2e-4, 5e-4])))
    optical = recorder.trial().optical
    assert optical is not None
    assert optical.residuals is not None
    np.testing.assert_array_equal(optical.residuals, [[np.nan, np.nan], [5e-4, 2e-4]])
