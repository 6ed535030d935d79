"""The recorded run, which is created once, because no test changes it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.reprocessing.recorded_run import RecordedRun, record_run

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="package")
def run(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    folder: Path = tmp_path_factory.mktemp("recording")
    return record_run(folder)
