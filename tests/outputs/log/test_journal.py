"""Journal handler: entries have fields; entries that journald refuses go to standard error."""

from __future__ import annotations

import io
import logging
import os
import socket
import sys
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.outputs.log import JournalHandler, is_journal, journal_fields
from jointfit_daemon.outputs.log._journal import datagram
from jointfit_daemon.outputs.log._rate_limit import BURST

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


def parsed(data: bytes) -> dict[str, str]:
    """Read a datagram as journald does: line by line, or by length after a bare name."""
    found = {}
    while data:
        line, _, rest = data.partition(b"\n")
        name, equals, value = line.partition(b"=")
        if equals:
            found[name.decode()] = value.decode()
            data = rest
        else:
            length = int.from_bytes(rest[:8], "little")
            found[name.decode()] = rest[8 : 8 + length].decode()
            assert rest[8 + length : 9 + length] == b"\n"
            data = rest[9 + length :]
    return found


@pytest.fixture
def journald(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "journal"))
        listener.setblocking(False)
        yield listener


@pytest.fixture
def stream() -> io.StringIO:
    return io.StringIO()


@pytest.fixture
def handler(journald: socket.socket, stream: io.StringIO) -> Iterator[JournalHandler]:
    made = JournalHandler("bench", address=journald.getsockname(), stream=stream)
    yield made
    made.close()


def logger_to(handler: logging.Handler) -> logging.Logger:
    made = logging.Logger("jointfit_daemon.test")  # noqa: LOG001 - a logger for each test
    made.addHandler(handler)
    return made


def test_entry_on_a_device_has_fields_of_rig_kind_and_id(
    handler: JournalHandler, journald: socket.socket, stream: io.StringIO
) -> None:
    logger_to(handler).warning("%s: gone", "S2", extra=journal_fields("device", "S2"))
    fields = parsed(journald.recv(65536))
    assert fields["MESSAGE"] == "jointfit_daemon.test: S2: gone"
    assert fields["PRIORITY"] == "4"
    assert fields["JOINTFIT_RIG"] == "bench"
    assert (fields["JOINTFIT_KIND"], fields["JOINTFIT_ID"]) == ("device", "S2")
    assert fields["CODE_FILE"] == __file__
    assert stream.getvalue() == ""


def test_a_traceback_is_one_entry(handler: JournalHandler, journald: socket.socket) -> None:
    try:
        int("x")
    except ValueError:
        logger_to(handler).exception("broken")
    message = parsed(journald.recv(65536))["MESSAGE"]
    assert message.startswith("jointfit_daemon.test: broken\nTraceback")
    assert message.endswith("ValueError: invalid literal for int() with base 10: 'x'")


def test_without_journald_lines_go_to_standard_error_with_level(
    handler: JournalHandler, journald: socket.socket, stream: io.StringIO
) -> None:
    os.unlink(journald.getsockname())  # noqa: PTH108 - a socket's address
    logger_to(handler).error("first\nsecond")
    assert stream.getvalue() == "<3>jointfit_daemon.test: first\n<3>second\n"


def test_line_longer_than_a_datagram_goes_to_standard_error(
    handler: JournalHandler, stream: io.StringIO
) -> None:
    logger_to(handler).info("x" * 10_000_000)
    assert len(stream.getvalue()) > 10_000_000


def test_rate_limit_is_optional(journald: socket.socket) -> None:
    for limited in (True, False):
        stream = io.StringIO()
        handler = JournalHandler("bench", limited=limited, address="nowhere", stream=stream)
        log = logger_to(handler)
        for number in range(200):
            log.warning("line %d", number)
        handler.close()
        assert (stream.getvalue().count("\n") < BURST + 10) is limited


@given(
    st.dictionaries(
        st.from_regex(r"[A-Z][A-Z0-9_]{0,20}", fullmatch=True),
        st.text(st.characters(exclude_categories=["Cs"])),
    )
)
def test_any_text_arrives_unchanged(fields: dict[str, str]) -> None:
    assert parsed(datagram(fields)) == fields


def test_journal_stream_is_recognized_by_its_inode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (tmp_path / "log").open("w") as log:
        found = os.fstat(log.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{found.st_dev}:{found.st_ino}")
        assert is_journal(log)
        assert not is_journal(io.StringIO())
        monkeypatch.setenv("JOURNAL_STREAM", f"{found.st_dev}:{found.st_ino + 1}")
        assert not is_journal(log)
        monkeypatch.delenv("JOURNAL_STREAM")
        assert not is_journal(sys.__stderr__ or log)
