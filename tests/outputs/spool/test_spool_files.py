"""Files of the spool: order, limited size, torn lines, full disks."""

from __future__ import annotations

import errno
import os
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.outputs.spool import SpoolFiles
from jointfit_daemon.outputs.spool._spool_files import FILES, SpooledMessage, _line, _message

if TYPE_CHECKING:
    from pathlib import Path


def message(number: int, size: int = 40) -> SpooledMessage:
    return SpooledMessage("late/pose", b'{"seq":%d,"x":"%s"}' % (number, b"x" * size))


def taken(files: SpoolFiles) -> list[SpooledMessage]:
    """Take all messages out of the spool."""
    found = []
    while (oldest := files.oldest()) is not None:
        number, messages = oldest
        found += messages
        files.remove(number)
    return found


def test_messages_of_several_processes_are_read_in_their_order(tmp_path: Path) -> None:
    for process in range(3):
        files = SpoolFiles(tmp_path, 100_000)
        files.load()
        files.append([message(10 * process), message(10 * process + 1)])
        files.append([message(10 * process + 2)])
    files = SpoolFiles(tmp_path, 100_000)
    files.load()
    assert files.waiting == 9
    assert taken(files) == [message(10 * process + k) for process in range(3) for k in range(3)]
    assert (files.waiting, files.size_bytes, list(tmp_path.iterdir())) == (0, 0, [])


def test_the_oldest_messages_of_a_full_spool_are_deleted_and_counted(tmp_path: Path) -> None:
    files = SpoolFiles(tmp_path, 16_000)
    for number in range(0, 1000, 10):
        files.append([message(number + k) for k in range(10)])
        stored = sum(path.stat().st_size for path in tmp_path.iterdir())
        assert stored == files.size_bytes <= 16_000 + 16_000 // FILES
    found = taken(files)
    assert found == [message(number) for number in range(1000 - len(found), 1000)]
    assert files.dropped == 1000 - len(found)
    assert len(found) > 100


def test_messages_are_stored_once_although_an_old_file_cannot_be_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = SpoolFiles(tmp_path, 16_000)

    def refuse(_: object, number: int) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(number))

    with monkeypatch.context() as failing:
        failing.setattr(SpoolFiles, "remove", refuse)
        for number in range(300):
            files.append([message(number)])
    assert files.dropped == 0
    files.append([message(300)])
    found = taken(files)
    assert found == [message(number) for number in range(301 - len(found), 301)]
    assert files.dropped == 301 - len(found) > 0


@pytest.mark.parametrize("cut", [1, 2, 30, 60, 95])
def test_a_line_that_a_power_cut_tore_is_counted_and_skipped(tmp_path: Path, cut: int) -> None:
    before = SpoolFiles(tmp_path, 100_000)
    before.append([message(1), message(2)])
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[:-cut])
    files = SpoolFiles(tmp_path, 100_000)
    files.load()
    files.append([message(3)])
    whole = [message(1)] if cut < len(_line(message(2))) else []
    assert taken(files) == [*whole, message(3)]
    assert files.damaged == 1


@pytest.mark.parametrize("topic", ["late/#", "late/+", "", "late\npose", "late/\0", "x" * 300])
def test_a_topic_that_no_client_can_publish_is_no_message(topic: str) -> None:
    assert _message(_line(SpooledMessage(topic, b"1"))) is None


@given(st.binary(max_size=200))
def test_random_bytes_are_no_message(data: bytes) -> None:
    found = _message(data)
    assert found is None or _line(found) == data


def test_a_message_that_a_full_disk_rejects_leaves_no_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files, write = SpoolFiles(tmp_path, 100_000), os.write
    files.append([message(1)])

    def write_some(descriptor: int, data: bytes) -> int:
        monkeypatch.setattr("os.write", fail)
        return write(descriptor, data[:17])

    def fail(_: int, __: bytes) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("os.write", write_some)
    with pytest.raises(OSError, match="No space"):
        files.append([message(2)])
    monkeypatch.setattr("os.write", write)
    files.append([message(2), message(3)])
    assert taken(files) == [message(1), message(2), message(3)]
