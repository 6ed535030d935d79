"""OpenSim reads TRC, MOT and STO files, places IMUs of a model with them, and tracks them."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from jointfit_daemon.files.sessions import read_session, write_session
from tests.files.sessions.session_samples import walking_session

if TYPE_CHECKING:
    from pathlib import Path

opensim: Any = pytest.importorskip("opensim")


@pytest.fixture(autouse=True)
def _quiet_library() -> None:
    opensim.Logger.setLevelString("off")


def test_markers_are_read_with_y_up_and_gaps(tmp_path: Path) -> None:
    session = walking_session()
    assert session.markers is not None
    path = write_session(session, tmp_path, "trc").files[0]
    table = opensim.TimeSeriesTableVec3(str(path)).flatten()
    assert table.getNumRows() == len(session.markers.t_s)
    np.testing.assert_allclose(list(table.getIndependentColumn()), session.markers.t_s)
    found = np.array([table.getDependentColumnAtIndex(k).to_numpy() for k in range(9)])
    expected = session.markers.positions[..., [1, 2, 0]].reshape(-1, 9).T
    np.testing.assert_allclose(found, expected, atol=1e-7)
    assert np.isnan(found).sum() == 15


def test_joint_angles_are_read_in_degrees_without_unknown_frames(tmp_path: Path) -> None:
    session = walking_session()
    path = write_session(session, tmp_path, "mot").files[0]
    table = opensim.TimeSeriesTable(str(path))
    assert table.getTableMetaDataAsString("inDegrees") == "yes"
    flexion = np.rad2deg(session.joints[0].angles["flexion"])
    known = ~np.isnan(flexion)
    np.testing.assert_allclose(
        table.getDependentColumn("knee_flexion").to_numpy(), flexion[known], rtol=1e-6
    )
    storage, column = opensim.Storage(str(path)), opensim.ArrayDouble()
    storage.getDataColumn("knee_flexion", column)
    assert storage.isInDegrees()
    assert column.getSize() == known.sum()


def test_imu_placer_and_imu_inverse_kinematics_run_on_exported_sensors(
    shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = shared_data / "opensense_xsens"
    for name in ("Rajagopal_2015.osim", "myIMUPlacer_Setup.xml", "myIMUIK_Setup.xml"):
        shutil.copyfile(source / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)

    # Text files of an Xsens program, whose serial numbers become the names of the model's bodies.
    session = read_session(source / "IMUData")
    assert len(session.sensors) == 8
    mapping = re.findall(
        r'name="_(\w+)">.*?<name_in_model>(\w+)<',
        (source / "myIMUMappings.xml").read_text(),
        re.DOTALL,
    )
    written = write_session(session, tmp_path, "sto", names=dict(mapping))
    written.files[0].rename("MT_012005D6_009-001_orientations.sto")

    assert opensim.IMUPlacer("myIMUPlacer_Setup.xml").run(False)
    placed = opensim.Model("Rajagopal_2015_calibrated.osim")
    assert placed.getBodySet().get("femur_r").hasComponent("femur_r_imu")

    tool = opensim.IMUInverseKinematicsTool("myIMUIK_Setup.xml")
    tool.setStartTime(0.0)
    tool.setEndTime(0.05)
    assert tool.run(False)
    found = opensim.TimeSeriesTable(str(next((tmp_path / "IKResults").glob("ik_*.mot"))))
    assert found.getNumRows() == 6
    # the person stands still, in the pose of the model
    knee = found.getDependentColumn("knee_angle_r").to_numpy()
    assert np.isfinite(knee).all()
    assert np.abs(knee).max() < 5.0


def test_a_hidden_last_marker_does_not_end_the_row(tmp_path: Path) -> None:
    session = walking_session()
    assert session.markers is not None
    positions = session.markers.positions.copy()
    positions[3:6, -1] = np.nan
    hidden = replace(session, markers=replace(session.markers, positions=positions))
    path = write_session(hidden, tmp_path, "trc").files[0]
    table = opensim.TimeSeriesTableVec3(str(path))
    assert table.getNumRows() == len(positions)
    last = table.getDependentColumnAtIndex(table.getNumColumns() - 1)
    assert [k for k in range(len(positions)) if np.isnan(last[k].get(0))] == [
        *np.flatnonzero(np.isnan(positions[:, -1, 0]))
    ]
    assert opensim.MarkersReference(str(path), opensim.SetMarkerWeights()).getNumFrames() > 0
