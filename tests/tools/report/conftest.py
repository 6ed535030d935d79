"""A recorded run for the tests of the command."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.reprocessing.recorded_run import record_run

if TYPE_CHECKING:
    from tests.reprocessing.recorded_run import RecordedRun


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    return record_run(tmp_path_factory.mktemp("recorded"))
