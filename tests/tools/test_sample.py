"""`jointfit sample`: the same files for the same seed, and every reader reads them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import orjson
import pytest
from typer.testing import CliRunner

from jointfit_daemon.files.mocap import c3d_bytes, read_trc
from jointfit_daemon.files.mocap._c3d import read_c3d
from jointfit_daemon.files.models import read_model, read_osim
from jointfit_daemon.files.orientations import read_orientations_npz, read_orientations_sto
from jointfit_daemon.tools.__main__ import app
from jointfit_simulators.sample import write_sample

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sample") / "data"
    done = CliRunner().invoke(app, ["sample", str(folder)])
    assert done.exit_code == 0, done.output
    listed = {line.split()[0] for line in done.stdout.splitlines()}
    assert listed == {path.name for path in folder.iterdir()}
    return folder


def test_the_same_seed_gives_the_same_files_within_three_megabytes(
    sample: Path, tmp_path: Path
) -> None:
    write_sample(tmp_path)
    first = {path.name: path.read_bytes() for path in sample.iterdir()}
    assert first == {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert sum(map(len, first.values())) < 3_000_000


def test_a_folder_with_something_in_it_is_refused_unless_forced(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")

    refused = CliRunner().invoke(app, ["sample", str(tmp_path)])
    assert refused.exit_code == 2
    assert "not empty" in refused.stderr
    assert "--force" in refused.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]

    forced = CliRunner().invoke(app, ["sample", str(tmp_path), "--force", "--seed", "2", "--json"])
    assert forced.exit_code == 0, forced.output
    assert set(orjson.loads(forced.stdout)["files"]) < {path.name for path in tmp_path.iterdir()}
    assert (tmp_path / "mine.txt").read_text() == "mine"
    assert (tmp_path / "rig.toml").exists()


def test_the_c3d_file_holds_the_markers_of_the_trc_file(sample: Path) -> None:
    pytest.importorskip("c3d")
    trial = read_c3d(sample / "squats.c3d")
    trc = read_trc(sample / "squats.trc")
    c3d = trial.trajectories
    assert trial.up_axis == "y"
    assert c3d.names == trc.names
    assert c3d.warnings == trc.warnings == ()
    np.testing.assert_allclose(c3d.t_s, trc.t_s)
    np.testing.assert_allclose(c3d.positions, trc.positions, atol=1e-6)
    assert np.isnan(trc.positions).any()


def test_another_c3d_library_reads_what_is_written(tmp_path: Path) -> None:
    ezc3d = pytest.importorskip("ezc3d")
    drawn = np.random.default_rng(3).uniform(-1.0, 1.0, (30, 2, 3))
    drawn[4, 1] = np.nan
    path = tmp_path / "two.c3d"
    path.write_bytes(c3d_bytes(("LASI", "RKNEE"), drawn, rate_hz=60.0, up="+Y"))

    found = ezc3d.c3d(str(path))
    points = found["parameters"]["POINT"]
    assert points["LABELS"]["value"] == ["LASI", "RKNEE"]
    assert points["RATE"]["value"][0] == 60.0
    np.testing.assert_allclose(
        found["data"]["points"][:3].transpose(2, 1, 0) / 1e3, drawn, atol=1e-6
    )


def test_both_models_are_one(sample: Path) -> None:
    written, imported = read_model(sample / "leg.toml"), read_osim(sample / "leg.osim").model
    assert imported.marker_names == written.marker_names
    np.testing.assert_allclose(imported.positions, written.positions, atol=1e-9)
    for ours, theirs in zip(written.segments, imported.segments, strict=True):
        assert (theirs.name, theirs.parent, theirs.joint.kind) == (
            ours.name,
            ours.parent,
            ours.joint.kind,
        )
        np.testing.assert_allclose(
            theirs.joint.center_in_parent, ours.joint.center_in_parent, atol=1e-9
        )
    knee = next(s.joint for s in imported.segments if s.name == "shank")
    np.testing.assert_allclose(knee.axis, (1.0, 0.0, 0.0), atol=1e-9)


def test_the_sto_file_holds_the_sensors_of_the_npz_file(sample: Path) -> None:
    table = read_orientations_sto(sample / "walking.sto")
    trial = read_orientations_npz(sample / "walking.npz")
    assert table.names == tuple(trial.sensors)
    for column, q in enumerate(trial.sensors.values()):
        np.testing.assert_allclose(table.quaternions[:, column], q, atol=1e-7)
