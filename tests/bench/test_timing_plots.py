"""Plots of simulated and recorded runs show their events; these tests need matplotlib."""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from bench.plots import __main__ as plots
from bench.rigs.core_trace import Trace, traced, true_errors
from bench.subjects.simulated_clocks import SimulatedRun, simulated
from tests.outputs.recording.recorded_events import write_recording

ROOT = Path(__file__).resolve().parents[2]
SECONDS = 16.0
STREAMS = {"S1", "S2", "S3", "S4", "mocap"}


@cache
def watched() -> tuple[SimulatedRun, Trace]:
    run = simulated(SECONDS)
    return run, traced(run.events)


@pytest.mark.experiment
def test_every_stream_is_traced_with_its_skew_and_the_error_of_its_stamps() -> None:
    run, trace = watched()
    assert set(trace.looks) == set(trace.stamps) == STREAMS
    errors = true_errors(trace, run.taken_ns, run.unseen_ns)
    for name in STREAMS - {"mocap"}:
        t_s, error, synced = errors[name]
        assert len(t_s) > 70 * SECONDS
        assert np.abs(error[synced]).max() < 0.5, name
    for looks in trace.looks.values():
        assert looks[-1].skew_ppm is not None
        assert abs(looks[-1].skew_ppm) < 80


@pytest.mark.experiment
def test_trace_contains_the_lag_that_clocks_cannot_estimate() -> None:
    run, trace = watched()
    for name, windows in trace.lags.items():
        good = [w.estimate for w in windows if w.estimate.refused is None]
        assert good or name == "S3"  # S3 reboots in the middle of the run
        for estimate in good:
            truth_ns = run.lag_ns[name] - trace.latency_ns[name]
            assert abs(estimate.lag_ns - truth_ns) < 4 * estimate.sigma_ns + 50_000


@pytest.mark.experiment
def test_trace_contains_both_incidents() -> None:
    """The incidents of the simulated run are a reboot of S3 and half a second of silence of S2."""
    run, trace = watched()
    gone_s = run.incidents["S3 reboots"]
    after = [row.synced for row in trace.stamps["S3"] if row.arrival_ns > _at(trace, gone_s + 1)]
    assert not after[0]
    assert after[-1]
    silent = _at(trace, run.incidents["S2 silent"])
    steps = np.diff([row.arrival_ns for row in trace.stamps["S2"]])
    assert steps.max() == pytest.approx(500e6, abs=30e6)
    assert any(frame.missing for frame in trace.frames if abs(frame.t_ns - silent) < 500_000_000)


def _at(trace: Trace, t_s: float) -> int:
    return trace.begin_ns + round(t_s * 1e9)


@pytest.mark.experiment
def test_a_recorded_run_is_drawn_like_a_simulated_one(tmp_path: Path) -> None:
    """The plots are drawn in a separate process, because matplotlib keeps font files open."""
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    log = write_recording(tmp_path / "recordings", simulated(12.0).events)
    pictures = tmp_path / "pictures"
    ran = subprocess.run(
        [sys.executable, "-m", "bench.plots", "clocks", str(pictures), "--replay", str(log)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300.0,  # at low priority, so that daemons of other tests are not delayed
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    drawn = {"clocks.png", "delays.png", "alignment.png", "lags.png"}
    assert {path.name for path in pictures.iterdir()} == drawn
    assert all(path.stat().st_size > 10_000 for path in pictures.iterdir())
    assert {*ran.stdout.split()} == {str(pictures / name) for name in drawn}


def test_unreadable_recording_is_reported_by_the_plots(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    (tmp_path / "empty").write_text("")
    assert plots.draw("clocks", tmp_path, tmp_path / "absent") == 2
    assert plots.draw("clocks", tmp_path, tmp_path / "empty") == 2
    assert "the file is empty" in capsys.readouterr().err
    with monkeypatch.context() as without:
        without.setattr(plots, "find_spec", lambda _: None)
        assert plots.draw("clocks", tmp_path, None) == 2
    assert "pip install 'jointfitd[plot]'" in capsys.readouterr().err
