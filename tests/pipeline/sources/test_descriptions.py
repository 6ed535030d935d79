"""Chunks that describe a source; a recording that starts later needs them to decode the data."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.config import parse_rig
from jointfit_daemon.model import Chunk
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import ChunkArrived, Configured, SourceClosed, SourceOpened
from jointfit_daemon.pipeline.sources._source_state import MOST_OPENING_BYTES
from tests.pipeline.core_feed import BEGIN_NS, chunk
from tests.reprocessing.recorded_run import rig_table

if TYPE_CHECKING:
    from jointfit_daemon.pipeline.events import Event

REPLY = b"a reply of the device during its configuration"


@pytest.fixture
def core() -> Core:
    opened = Core()
    opened.feed(Configured(BEGIN_NS, parse_rig(rig_table()), None))
    opened.feed(SourceOpened(BEGIN_NS, "S1"))
    return opened


def arrived(data: bytes) -> Event:
    return ChunkArrived("S1", Chunk(BEGIN_NS, data))


def test_chunks_before_the_first_sample_describe_a_source(core: Core) -> None:
    core.feed(arrived(REPLY))
    assert core.descriptions()["S1"] == (REPLY,)
    for number in range(5):
        core.feed(chunk("S1", number))
    core.feed(arrived(b"a later message"))
    assert core.descriptions()["S1"] == (REPLY,)
    assert core.descriptions()["S2"] == ()


def test_a_closed_source_has_no_description_and_a_reopened_one_a_new_one(core: Core) -> None:
    core.feed(arrived(REPLY))
    core.feed(SourceClosed(BEGIN_NS, "S1", "lost", "unplugged"))
    assert core.descriptions()["S1"] == ()
    core.feed(SourceOpened(BEGIN_NS, "S1"))
    assert core.descriptions()["S1"] == ()
    core.feed(arrived(b"another reply"))
    assert core.descriptions()["S1"] == (b"another reply",)


def test_a_device_without_samples_takes_bounded_memory(core: Core) -> None:
    for _ in range(100):
        core.feed(arrived(REPLY * 50))
    kept = sum(map(len, core.descriptions()["S1"]))
    assert 0 < kept <= MOST_OPENING_BYTES
