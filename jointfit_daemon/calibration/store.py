"""Calibrations on disk: numbered versions, written whole or not at all.

Law: a version, once written, is never touched again; a reader sees a complete file or none. Text
is written aside, flushed to the medium, then linked under its number, which fails if that number
exists; the directory is flushed last. A stop at any moment leaves the previous version in force.
"""

from __future__ import annotations

import errno
import json
import os
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from jointfit_daemon.calibration.result import Calibration, UnknownSchema

if TYPE_CHECKING:
    from pathlib import Path

_NO_LINKS = (errno.EPERM, errno.ENOTSUP)
_NUMBERED = re.compile(r"(\d{4,})\.json")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


class CalibrationUnreadable(Exception):  # noqa: N818 - named for what happened
    """A stored file is damaged or of another program; the message names the file and the remedy."""


@dataclass(frozen=True, slots=True)
class Stored:
    """A calibration as found."""

    calibration: Calibration
    version: int
    notes: tuple[str, ...] = ()
    """Newer versions that could not be read, one sentence each."""


class CalibrationStore:
    """The versions of one name under one directory: ``DIRECTORY/NAME/0001.json`` and on.

    Parameters
    ----------
    directory : Path
        Usually ``$STATE_DIRECTORY/calibrations``; made when first written to.
    name : str
        Of the wearer or session: letters, digits, ``. _ -``, starting with a letter or digit.

    Raises
    ------
    ValueError
        The name would leave the directory or needs other characters.
    """

    def __init__(self, directory: Path, name: str) -> None:
        if not _NAME.fullmatch(name):
            raise ValueError(
                f"calibration store {name!r}: use letters, digits, '.', '_' and '-', "
                "and start with a letter or digit"
            )
        self._directory = directory / name

    def versions(self) -> list[int]:
        """Return the numbers of all versions, oldest first."""
        if not self._directory.is_dir():
            return []
        found = (_NUMBERED.fullmatch(path.name) for path in self._directory.iterdir())
        return sorted(int(match[1]) for match in found if match)

    def path(self, version: int) -> Path:
        """Return where a version lies, whether it exists or not."""
        return self._directory / f"{version:04d}.json"

    def save(self, calibration: Calibration) -> int:
        """Write a new version and return its number; durable when this returns.

        Raises
        ------
        OSError
            The medium is full, read-only or gone; nothing was changed then.
        """
        self._directory.mkdir(parents=True, exist_ok=True)
        text = json.dumps(calibration.to_dict(), allow_nan=False, indent=1) + "\n"
        aside = self._directory / f".writing-{os.getpid()}"
        try:
            with aside.open("w", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            version = self._link(aside)
        finally:
            aside.unlink(missing_ok=True)
        self._flush_directory()
        return version

    def _link(self, aside: Path) -> int:
        """Give the file the next free number. A hard link, unlike a rename, never replaces."""
        version = max(self.versions(), default=0) + 1
        while True:
            try:
                os.link(aside, self.path(version))
            except FileExistsError:  # another process was first: its version stays
                version += 1
            except OSError as error:
                if error.errno not in _NO_LINKS:
                    raise
                aside.rename(self.path(version))  # FAT and the like: atomic, one writer trusted
                return version
            else:
                return version

    def _flush_directory(self) -> None:
        descriptor = os.open(self._directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def load(self, version: int) -> Calibration:
        """Return one version.

        Raises
        ------
        CalibrationUnreadable
            No such version, or the file is damaged.
        """
        path = self.path(version)
        try:
            return Calibration.from_dict(json.loads(path.read_text(encoding="utf-8")))
        except FileNotFoundError as error:
            known = ", ".join(map(str, self.versions())) or "none"
            raise CalibrationUnreadable(f"{path}: no such version; stored: {known}") from error
        except (UnknownSchema, ValueError, AttributeError, OSError) as error:
            raise CalibrationUnreadable(
                f"{path}: cannot be read ({error}); move it away or calibrate again"
            ) from error

    def latest(self) -> Stored | None:
        """Return the newest readable version, with a note for every newer one that is not.

        Raises
        ------
        CalibrationUnreadable
            There are versions and none can be read.
        """
        notes: list[str] = []
        for version in reversed(self.versions()):
            try:
                return Stored(self.load(version), version, tuple(notes))
            except CalibrationUnreadable as error:
                notes.append(f"{error}; the version before is used")
        if notes:
            raise CalibrationUnreadable("; ".join(notes))
        return None
