"""A recorded run for the tests of `jointfit report`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.reprocessing.recorded_run import record_run

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the file of a recorded run."""
    folder = tmp_path_factory.mktemp("recorded")
    record_run(folder)
    (file,) = folder.iterdir()
    return file
