"""Truncated TRC files and files of other formats are rejected with the cause and a remedy."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.files.mocap import (
    MarkerTrajectories,
    read_marker_trial,
    read_trc,
    write_trc,
)
from jointfit_daemon.files.text import MalformedFileError

if TYPE_CHECKING:
    from pathlib import Path


def test_marker_name_that_occurs_twice_is_refused_with_its_columns(tmp_path: Path) -> None:
    positions = np.zeros((2, 3, 3))
    times, frames = np.array([0.0, 0.01]), np.array([1, 2])
    names = ("T1", "T3", "T3")
    write_trc(tmp_path / "m.trc", MarkerTrajectories(names, times, frames, positions, 100.0))
    with pytest.raises(MalformedFileError, match="'T3' occurs 2 times, in columns 6 and 9"):
        read_trc(tmp_path / "m.trc")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("time,x\n0,1\n", "line 1: not a TRC file: found 'time,x', expected PathFileType in the"),
        ("", "line 1: not a TRC file: found '', expected"),
        (
            "PathFileType\t4\t(X/Y/Z)\tm.trc\nDataRate\n",
            "ends after line 2, expected 5 lines of header and one line per frame: export",
        ),
    ],
)
def test_each_fault_names_what_was_found(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "m.trc").write_text(text, encoding="utf-8")
    with pytest.raises(MalformedFileError) as caught:
        read_trc(tmp_path / "m.trc")
    assert said in str(caught.value)


def test_a_recording_is_refused_with_the_command_that_exports_it(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "demo-20260131T120000-0001.mcap"):
        with pytest.raises(MalformedFileError, match="jointfit export --to trc"):
            read_marker_trial(path)
