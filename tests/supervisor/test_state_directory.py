"""The state directory: lock, private files, and check for write access."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.supervisor.state_directory import (
    StateDirectoryInUseError,
    lock_state,
    make_private,
    write_fault,
)

if TYPE_CHECKING:
    from pathlib import Path


def mode(path: Path) -> int:
    return path.stat().st_mode & 0o777


def test_second_lock_names_the_process_of_the_first(tmp_path: Path) -> None:
    held = lock_state(tmp_path / "state")
    assert held is not None
    with pytest.raises(StateDirectoryInUseError, match=f"process {os.getpid()}.*STATE_DIRECTORY"):
        lock_state(tmp_path / "state")
    os.close(held)


def test_a_lock_ends_with_its_process(tmp_path: Path) -> None:
    code = (
        "import os, sys, pathlib;"
        "from jointfit_daemon.supervisor.state_directory import lock_state;"
        "assert lock_state(pathlib.Path(sys.argv[1])); os.kill(os.getpid(), 9)"
    )
    ended = subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    assert ended.returncode == -9
    held = lock_state(tmp_path)
    assert held is not None
    os.close(held)


def test_a_directory_that_cannot_be_made_is_not_locked_and_named(tmp_path: Path) -> None:
    blocked = tmp_path / "file" / "state"
    blocked.parent.write_text("")
    assert lock_state(blocked) is None
    assert write_fault(blocked) == f"{blocked}: Not a directory"
    assert write_fault(tmp_path / "new") is None
    assert list((tmp_path / "new").iterdir()) == []


def test_a_link_in_place_of_the_lock_is_not_followed(tmp_path: Path) -> None:
    target = tmp_path / "target"
    (tmp_path / "lock").symlink_to(target)
    assert lock_state(tmp_path) is None
    assert not target.exists()


@pytest.mark.parametrize("folder", ["calibrations", "recordings", "spool"])
def test_files_of_earlier_daemons_become_private_and_others_stay(
    tmp_path: Path, folder: str
) -> None:
    ours = tmp_path / folder / "s" / "0001.json"
    theirs = tmp_path / "notes" / "text"
    for path in (ours, theirs):
        path.parent.mkdir(parents=True)
        path.write_text("")
        path.chmod(0o644)
        path.parent.chmod(0o755)
    outside = tmp_path.parent / "outside"
    outside.write_text("")
    outside.chmod(0o644)
    (ours.parent / "link").symlink_to(outside)
    tmp_path.chmod(0o755)
    make_private(tmp_path)
    assert [mode(path) for path in (ours, ours.parent, tmp_path)] == [0o600, 0o700, 0o700]
    assert [mode(path) for path in (theirs, theirs.parent, outside)] == [0o644, 0o755, 0o644]
