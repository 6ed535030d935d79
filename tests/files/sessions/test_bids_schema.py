"""Motion-BIDS data sets fulfil the machine-readable schema of the specification."""

from __future__ import annotations

import csv
import json
from typing import TYPE_CHECKING, Any

import jsonschema
import numpy as np
import pytest

from jointfit_daemon.files.sessions import write_session
from tests.files.sessions.session_samples import walking_session

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

schema_tools: Any = pytest.importorskip("bidsschematools.schema")


@pytest.fixture(scope="module")
def rules() -> Any:
    return schema_tools.load_schema().to_dict()


@pytest.fixture(scope="module")
def data_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bids")
    write_session(walking_session(), folder, "bids-motion")
    return folder / "walk_bids"


def table(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file, delimiter="\t", quoting=csv.QUOTE_NONE))


def levels(fields: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for name, rule in fields.items():
        yield name, rule if isinstance(rule, str) else rule["level"]


def check_metadata(content: dict[str, Any], definitions: dict[str, Any]) -> None:
    """Validate every known key of a JSON file against its definition."""
    for key, value in content.items():
        if key in definitions:
            jsonschema.validate(value, definitions[key])


def test_every_file_has_a_name_of_the_specification(data_set: Path) -> None:
    validator: Any = pytest.importorskip("bidsschematools.validator")
    stray = data_set / "sub-01" / "motion" / "sub-01_task-walk_tracksys-x_motion.xls"
    stray.write_text("")
    found = validator.validate_bids(str(data_set))
    stray.unlink()
    assert [path for path in found["path_tracking"] if path.endswith((".tsv", ".json"))] == []
    assert [path for path in found["path_tracking"] if path.endswith(".xls")]
    assert len(list(data_set.rglob("*_motion.tsv"))) == 5


def test_sidecars_have_all_required_fields_with_valid_values(rules: Any, data_set: Path) -> None:
    definitions = rules["objects"]["metadata"]
    sidecars = list(data_set.rglob("*_motion.json"))
    assert sidecars
    for path in sidecars:
        content = json.loads(path.read_text())
        check_metadata(content, definitions)
        for part in rules["rules"]["sidecars"]["motion"].values():
            missing = {n for n, level in levels(part["fields"]) if level == "required"}
            assert missing <= content.keys()
        channels = table(path.with_name(path.name.replace("_motion.json", "_channels.tsv")))
        assert content["MotionChannelCount"] == len(channels)
        assert content["LATENCYChannelCount"] == 1

    content = json.loads((data_set / "dataset_description.json").read_text())
    check_metadata(content, definitions)
    described = rules["rules"]["json"]["dataset"]["dataset_description"]["fields"]
    assert {n for n, level in levels(described) if level == "required"} <= content.keys()


def test_channels_have_the_columns_and_words_of_the_specification(
    rules: Any, data_set: Path
) -> None:
    part = rules["rules"]["tabular_data"]["motion"]["motionChannels"]
    columns = rules["objects"]["columns"]
    initial = [columns[key]["name"] for key in part["initial_columns"]]
    allowed = {columns[key]["name"] for key in part["columns"]}
    kinds = set(rules["objects"]["columns"]["type__channels"].get("enum", []))
    components = set(columns["component"]["enum"])
    for path in data_set.rglob("*_channels.tsv"):
        rows = table(path)
        assert [*rows[0]][: len(initial)] == initial
        assert set(rows[0]) <= allowed
        assert {row["component"] for row in rows} <= components | {"n/a"}
        assert not kinds or {row["type"] for row in rows} <= kinds
        assert len({row["name"] for row in rows}) == len(rows)
        sidecar = json.loads(path.with_suffix(".json").read_text())
        frames = {row["reference_frame"] for row in rows} - {"n/a"}
        assert frames <= sidecar["reference_frame"]["Levels"].keys()
        for level in sidecar["reference_frame"]["Levels"].values():
            assert {"SpatialAxes", "RotationRule", "RotationOrder"} <= level.keys()


def test_motion_has_one_column_for_each_channel_and_n_a_for_gaps(data_set: Path) -> None:
    for path in data_set.rglob("*_motion.tsv"):
        width = len(table(path.with_name(path.name.replace("_motion", "_channels"))))
        rows = [line.split("\t") for line in path.read_text().splitlines()]
        assert {len(row) for row in rows} == {width}
        times = np.array([row[0] for row in rows], dtype=float)
        assert (np.diff(times) > 0.0).all()
    markers = next(data_set.rglob("*markers_motion.tsv")).read_text()
    assert "n/a" in markers
    assert "nan" not in markers


def test_events_and_participants_have_their_required_columns(rules: Any, data_set: Path) -> None:
    events = table(next(data_set.rglob("*_events.tsv")))
    assert [*events[0]][:2] == ["onset", "duration"]
    assert [row["trial_type"] for row in events] == ["mark", "fault"]
    assert table(data_set / "participants.tsv") == [{"participant_id": "sub-01"}]
    scans = table(next(data_set.rglob("*_scans.tsv")))
    pattern = rules["objects"]["formats"]["datetime"]["pattern"]
    for row in scans:
        assert (data_set / "sub-01" / row["filename"]).exists()
        jsonschema.validate(row["acq_time"], {"type": "string", "pattern": f"^(?:{pattern})$"})
