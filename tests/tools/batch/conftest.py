"""Folders of recordings for the tests of `jointfit batch`."""

from __future__ import annotations

import shutil
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING

import pytest

from tests.reprocessing.recorded_run import record_run

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@pytest.fixture(scope="session", autouse=True)
def process_tracker() -> None:
    """Start the resource tracker of multiprocessing before the tests.

    The pipe of the tracker remains open until Python ends. If a test started the tracker, the
    check for open file descriptors after this test would fail.
    """
    resource_tracker.ensure_running()


@pytest.fixture(scope="session")
def recorded_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    record_run(folder)
    (file,) = folder.iterdir()
    return file


@pytest.fixture
def recordings(recorded_file: Path, tmp_path: Path) -> Callable[[int], Path]:
    """Return a function that creates a folder with a number of copies of one recording."""

    def make(count: int) -> Path:
        folder = tmp_path / "trials"
        folder.mkdir()
        ending = "".join(recorded_file.suffixes[-1:])
        for number in range(count):
            shutil.copy(recorded_file, folder / f"trial-{number:04d}{ending}")
        return folder

    return make
