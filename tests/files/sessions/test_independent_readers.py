"""Independent libraries read the same values from the written files."""

from __future__ import annotations

import json
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from jointfit_daemon.files.sessions import write_session
from jointfit_daemon.session_data import MarkerSeries, SessionData
from tests.files.sessions.session_samples import RATE_HZ, ROWS, START_NS, walking_session

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module")
def session() -> SessionData:
    return walking_session()


def test_ezc3d_reads_points_gaps_frames_and_events(session: SessionData, tmp_path: Path) -> None:
    ezc3d: Any = pytest.importorskip("ezc3d")
    path = write_session(session, tmp_path, "c3d").files[0]
    found = ezc3d.c3d(str(path))
    points, events = found["parameters"]["POINT"], found["parameters"]["EVENT"]
    assert points["LABELS"]["value"] == ["T1", "T2", "Knie-ü"]
    assert points["RATE"]["value"][0] == RATE_HZ
    assert found["header"]["points"]["first_frame"] == 300
    assert session.markers is not None
    np.testing.assert_allclose(
        found["data"]["points"][:3].transpose(2, 1, 0) / 1e3, session.markers.positions, atol=1e-6
    )
    assert events["LABELS"]["value"] == ["mark", "fault"]
    assert events["DESCRIPTIONS"]["value"] == ["heel strike", "sensor slip"]
    np.testing.assert_allclose(
        np.array(events["TIMES"]["value"]), [[0.0, 0.0], [3.25, 4.5]], atol=1e-5
    )


def test_the_c3d_package_reads_the_same_points(session: SessionData, tmp_path: Path) -> None:
    c3d: Any = pytest.importorskip("c3d")
    path = write_session(session, tmp_path, "c3d").files[0]
    with path.open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # c3d expects groups of analog channels
        reader = c3d.Reader(file)
        frames = np.array([points for _, points, _ in reader.read_frames()])
        assert (reader.first_frame, reader.last_frame) == (301, 500)
    assert session.markers is not None
    seen = frames[..., 3] >= 0.0
    assert (seen == ~np.isnan(session.markers.positions[..., 0])).all()
    np.testing.assert_allclose(
        frames[..., :3][seen] / 1e3, session.markers.positions[seen], atol=1e-6
    )


def test_a_c3d_file_counts_more_than_65535_frames(tmp_path: Path) -> None:
    ezc3d: Any = pytest.importorskip("ezc3d")
    t_s = np.arange(66_000) / RATE_HZ
    positions = np.zeros((66_000, 1, 3))
    positions[:, 0, 0] = t_s
    session = SessionData("long", markers=MarkerSeries(("A",), t_s, positions))
    path = write_session(session, tmp_path, "c3d").files[0]
    points = ezc3d.c3d(str(path))["data"]["points"]
    assert points.shape[2] == 66_000
    assert points[0, 0, -1] / 1e3 == pytest.approx(t_s[-1], rel=1e-6)


@pytest.mark.parametrize("dejitter", [False, True])
def test_pyxdf_reads_streams_stamps_and_events(
    session: SessionData, tmp_path: Path, dejitter: bool
) -> None:
    pyxdf: Any = pytest.importorskip("pyxdf")
    path = write_session(session, tmp_path, "xdf").files[0]
    streams, header = pyxdf.load_xdf(str(path), dejitter_timestamps=dejitter)
    by_name = {stream["info"]["name"][0]: stream for stream in streams}
    assert by_name.keys() == {"S1", "S2", "markers", "thigh", "knee", "events"}
    assert header["info"]["start_unix_ns"] == [str(START_NS)]
    for sensor in session.sensors:
        stream = by_name[sensor.id]
        labels = [c["type"][0] for c in stream["info"]["desc"][0]["channels"][0]["channel"]]
        assert labels[:4] == ["OrientationW", "OrientationX", "OrientationY", "OrientationZ"]
        np.testing.assert_allclose(stream["time_stamps"], sensor.t_s, atol=1e-6)
        np.testing.assert_array_equal(stream["time_series"][:, :4], sensor.orientation)
    assert [row[0] for row in by_name["events"]["time_series"]] == ["mark", "fault"]
    np.testing.assert_allclose(by_name["events"]["time_stamps"], [3.25, 4.5])
    offsets = by_name["S1"]["footer"]["info"]
    assert offsets["sample_count"] == [str(ROWS)]


def test_pyarrow_reads_typed_columns_with_null_for_unknown(
    session: SessionData, tmp_path: Path
) -> None:
    parquet: Any = pytest.importorskip("pyarrow.parquet")
    files = {path.stem: path for path in write_session(session, tmp_path, "parquet").files}
    sensors = parquet.read_table(files["walk_sensors"])
    assert sensors["qw"].null_count == 6
    assert sensors["angular_velocity_x_rad_s"].null_count == ROWS - 2
    assert set(sensors["sensor"].to_pylist()) == {"S1", "S2"}
    facts = json.loads(sensors.schema.metadata[b"jointfit"])
    assert facts == {"start_unix_ns": START_NS, "name": "walk"}
    angles = parquet.read_table(files["walk_angles"]).to_pydict()
    assert angles["angle_deg"][0] == pytest.approx(np.rad2deg(np.sin(3.0)))
    assert angles["angle_deg"][7] is None
    assert angles["sd_deg"][0] == pytest.approx(np.rad2deg(0.02))


def test_mcap_and_protobuf_decode_the_messages_for_foxglove(
    session: SessionData, tmp_path: Path
) -> None:
    pytest.importorskip("foxglove_schemas_protobuf")
    decoder: Any = pytest.importorskip("mcap_protobuf.decoder")
    from mcap.reader import make_reader  # noqa: PLC0415 - beside its decoder

    path = write_session(session, tmp_path, "mcap-foxglove").files[0]
    transforms: dict[str, dict[float, Any]] = {}
    markers: dict[float, Any] = {}
    angles: dict[float, Any] = {}
    logs, times = [], []
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        assert all(index.message_index_offsets for index in summary.chunk_indexes)
        for schema, channel, message in make_reader(file).iter_messages():
            times.append(message.log_time)
            t_s = round((message.log_time - START_NS) / 1e9, 7)
            if schema is not None and schema.encoding == "jsonschema":
                angles[t_s] = json.loads(message.data)
                continue
            decode = decoder.DecoderFactory().decoder_for("protobuf", schema)
            content = decode(message.data)
            if channel.topic == "/tf":
                one = content.transforms[0]
                assert one.timestamp.ToNanoseconds() == message.log_time
                transforms.setdefault(one.child_frame_id, {})[t_s] = one
            elif channel.topic == "/markers":
                places = [pose.position for pose in content.poses]
                markers[t_s] = [[place.x, place.y, place.z] for place in places]
            else:
                logs.append((content.name, content.message, content.level))

    assert times == sorted(times)
    assert transforms.keys() == {"S1", "S2", "thigh", "joint/knee"}
    for sensor in session.sensors:
        seen = ~np.isnan(sensor.orientation[:, 0])
        found = transforms[sensor.id]
        np.testing.assert_allclose([*found], sensor.t_s[seen], atol=1e-6)
        q = [[o.rotation.w, o.rotation.x, o.rotation.y, o.rotation.z] for o in found.values()]
        np.testing.assert_array_equal(q, sensor.orientation[seen])
    assert session.markers is not None
    for rows, places in zip(markers.values(), session.markers.positions, strict=True):
        np.testing.assert_array_equal(rows, places[~np.isnan(places[:, 0])])
    flexion = [content["angles_deg"]["flexion"] for content in angles.values()]
    assert flexion[7] is None
    assert flexion[0] == pytest.approx(np.rad2deg(np.sin(3.0)))
    assert logs == [("mark", "mark: heel strike", 2), ("S1", "fault: sensor slip", 3)]


def test_pandas_like_reading_of_csv_needs_no_header_rules(
    session: SessionData, tmp_path: Path
) -> None:
    files = {path.stem: path for path in write_session(session, tmp_path, "csv").files}
    table = np.genfromtxt(
        files["walk_angles"], delimiter=",", names=True, dtype=None, encoding="utf-8"
    )
    assert table.dtype.names == ("t_s", "source", "joint", "angle", "angle_deg", "sd_deg")
    assert np.isnan(table["angle_deg"][7])
    np.testing.assert_allclose(table["t_s"][:2], [3.0, 3.01])
