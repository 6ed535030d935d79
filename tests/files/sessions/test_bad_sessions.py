"""Damaged, foreign and hostile files are refused by name; a failed export writes no file."""

from __future__ import annotations

import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jointfit_daemon.files.mocap import MissingPackageError
from jointfit_daemon.files.sessions import NothingToWriteError, read_session, write_session
from jointfit_daemon.files.sessions._tidy_tables import TEXT_COLUMNS
from jointfit_daemon.files.text import MalformedFileError
from jointfit_daemon.session_data import SessionData
from tests.files.sessions.session_samples import walking_session

FORMATS = ("trc", "c3d", "sto", "mot", "csv", "parquet", "xdf")
EDITS = st.lists(
    st.tuples(st.floats(0.0, 1.0), st.integers(0, 9), st.binary(max_size=6)), min_size=1, max_size=5
)
MTB = """// Start Time: Unknown
// Update Rate: 100.0Hz
PacketCounter\tAcc_X\tAcc_Y\tAcc_Z\tQuat_q0\tQuat_q1\tQuat_q2\tQuat_q3
65534\t0.1\t0.2\t9.8\t1\t0\t0\t0
65535\t0.1\t0.2\t9.8\t0\t1\t0\t0
1\t0.1\t0.2\t9.8\t0\t0\t1\t0
"""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    pytest.importorskip("pyarrow")
    folder = tmp_path_factory.mktemp("written")
    files = {to: write_session(walking_session(), folder, to).files for to in FORMATS}
    chosen = {to: found[0] for to, found in files.items()}
    chosen["csv"] = next(path for path in files["csv"] if "sensors" in path.name)
    text = folder / "MT_00B421E6.txt"
    text.write_text(MTB)
    return chosen | {"mtb": text}


def refusal(path: Path) -> str:
    """Return the error message for a file; an empty text if the file can be read."""
    message = ""
    try:
        read_session(path)
    except MalformedFileError as error:
        message = str(error)
    assert not message or path.name.split("_")[0] in message
    return message


@pytest.mark.parametrize("kind", [*FORMATS, "mtb"])
@settings(max_examples=20, deadline=None, suppress_health_check=list(HealthCheck))
@given(edits=EDITS, cut=st.none() | st.floats(0.0, 1.0))
def test_a_damaged_file_is_read_or_refused(
    written: dict[str, Path],
    tmp_path_factory: pytest.TempPathFactory,
    kind: str,
    edits: list[tuple[float, int, bytes]],
    cut: float | None,
) -> None:
    data = written[kind].read_bytes()
    for share, removed, put in edits:
        at = round(share * len(data))
        data = data[:at] + put + data[at + removed :]
    if cut is not None:
        data = data[: round(cut * len(data))]
    path = written[kind].with_name(f"damaged_{written[kind].name}")
    path.write_bytes(data)
    refusal(path)


@pytest.mark.parametrize("kind", [*FORMATS, "mtb"])
@pytest.mark.parametrize("content", [b"", bytes(3000), b"<!DOCTYPE html><html></html>"])
def test_foreign_content_is_refused(
    written: dict[str, Path], tmp_path: Path, kind: str, content: bytes
) -> None:
    path = tmp_path / written[kind].name
    path.write_bytes(content)
    assert refusal(path)


def test_a_length_of_gigabytes_takes_no_memory(written: dict[str, Path], tmp_path: Path) -> None:
    path = tmp_path / "vast.xdf"
    path.write_bytes(b"XDF:\x08" + (1 << 40).to_bytes(8, "little") + b"\x03\x00\x01\x00\x00\x00")
    assert "declares 1099511627776 bytes" in refusal(path)


def test_rows_that_take_no_space_are_refused_before_they_are_read(
    written: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    sensors = written["parquet"].with_name("walk_sensors.parquet")
    table = parquet.read_table(sensors)
    path = tmp_path / sensors.name
    parquet.write_table(arrow.concat_tables([table.slice(0, 1)] * 5000).combine_chunks(), path)
    monkeypatch.setattr("jointfit_daemon.files.sessions._table_files.MOST_VALUES", 10_000)
    assert path.stat().st_size < 100_000
    assert "declares 5000 rows" in refusal(path)


def test_a_long_text_in_every_row_takes_its_memory_once(
    written: dict[str, Path], tmp_path: Path
) -> None:
    arrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    sensors = written["parquet"].with_name("walk_sensors.parquet")
    table = parquet.read_table(sensors)
    at = next(k for k, name in enumerate(table.column_names) if name in TEXT_COLUMNS)
    long = arrow.array(["x" * 50_000] * len(table), arrow.string())
    path = tmp_path / sensors.name
    parquet.write_table(
        table.set_column(at, table.column_names[at], long), path, store_schema=False
    )
    assert len(table) > 300
    tracemalloc.start()
    try:
        refusal(path)
        assert tracemalloc.get_traced_memory()[1] < 8_000_000
    finally:
        tracemalloc.stop()


def test_entities_of_an_xdf_header_are_never_expanded(tmp_path: Path) -> None:
    xml = b'<!DOCTYPE i [<!ENTITY a "aaaaaaaa">]><info>&a;</info>'
    path = tmp_path / "bomb.xdf"
    path.write_bytes(b"XDF:\x01" + bytes([len(xml) + 2]) + b"\x01\x00" + xml)
    assert "damaged chunk at byte 4" in refusal(path)


def swap_rows(text: str) -> str:
    lines = text.splitlines()
    lines[-1], lines[-2] = lines[-2], lines[-1]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("kind", ["trc", "sto", "mot", "mtb"])
def test_time_that_runs_backwards_is_refused_with_its_row(
    written: dict[str, Path], tmp_path: Path, kind: str
) -> None:
    path = tmp_path / written[kind].name
    path.write_text(swap_rows(written[kind].read_text()))
    assert "time does not increase from row" in refusal(path)


def test_lost_packets_and_turns_of_the_counter_are_gaps_in_time(written: dict[str, Path]) -> None:
    sensor = read_session(written["mtb"]).sensors[0]
    assert sensor.id == "00B421E6"
    np.testing.assert_allclose(sensor.t_s, [0.0, 0.01, 0.03])
    assert sensor.acceleration is not None


EMPTY = SessionData("empty")


@pytest.mark.parametrize("to", ["trc", "c3d", "sto", "mot"])
def test_an_export_without_content_is_refused_and_leaves_nothing(to: str, tmp_path: Path) -> None:
    with pytest.raises(NothingToWriteError, match="'empty' has no"):
        write_session(EMPTY, tmp_path, to)
    assert [*tmp_path.iterdir()] == []


def test_a_failing_export_leaves_the_former_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = walking_session()
    files = write_session(session, tmp_path, "csv").files
    before = {path: path.read_bytes() for path in files}
    with pytest.raises(FileExistsError, match="exists: choose another folder"):
        write_session(session, tmp_path, "csv")

    write_text = Path.open

    def full(path: Path, *arguments: str, **options: str) -> object:
        if path.name.endswith("angles.csv"):
            raise OSError(28, "No space left on device", str(path))
        return write_text(path, *arguments, **options)  # type: ignore[call-overload]

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(OSError, match="No space"):
        write_session(session, tmp_path, "csv", overwrite=True)
    monkeypatch.undo()
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_name_with_slashes_becomes_a_file_name(tmp_path: Path) -> None:
    session = replace(walking_session(), name="../a/b")
    files = write_session(session, tmp_path, "trc").files
    assert [path.name for path in files] == ["_a_b.trc"]
    assert files[0].parent == tmp_path


@pytest.mark.parametrize(
    ("to", "module", "extra"),
    [
        ("parquet", "pyarrow", "parquet"),
        ("mcap-foxglove", "mcap_protobuf.schema", "foxglove"),
    ],
)
def test_a_missing_package_is_named_with_its_command(
    to: str, module: str, extra: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingPackageError, match=rf"pip install 'jointfitd\[{extra}\]'"):
        write_session(walking_session(), tmp_path, to)
    assert [*tmp_path.iterdir()] == []


DAMAGED_DATA_SETS: dict[str, tuple[str, str | None]] = {
    "no file _motion.tsv": ("*_motion.tsv", None),
    "cells, expected": ("*S1_motion.tsv", "1\t2\n"),
    "expected name": ("*S1_channels.tsv", "a\tb\n"),
    "_channels.tsv": ("*S1_channels.tsv", None),
}
"""Name pattern of the damaged files and their content (None: removed), by the expected words."""


@pytest.mark.parametrize("words", DAMAGED_DATA_SETS)
def test_a_damaged_data_set_is_refused(words: str, tmp_path: Path) -> None:
    write_session(walking_session(), tmp_path, "bids-motion")
    root = tmp_path / "walk_bids"
    pattern, content = DAMAGED_DATA_SETS[words]
    for path in [*root.rglob(pattern)]:
        path.unlink()
        if content is not None:
            path.write_text(content)
    with pytest.raises((MalformedFileError, FileNotFoundError), match=words):
        read_session(root)
