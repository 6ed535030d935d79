"""Versioned store of calibrations: atomic writes, checksums, and quarantine of damaged files.

Invariant: a stored version never changes, and a reader never finds an incomplete file. The text is
written to a temporary file, flushed to the storage medium, and linked under the number of the
version. Linking fails if the number exists. The directory is flushed last. After an interruption at
any point, the newest version is either the previous one or the complete new one.

A file is ``{"sha256": …, "calibration": {…}}``; the checksum is computed from the calibration as
JSON with sorted keys and without whitespace. A file with unusable content is renamed to ``….bad``
and never deleted, so that its number is not used again.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from jointfit_daemon.calibration.record._content_check import content_faults
from jointfit_daemon.files.text import (
    MalformedFileError,
    find_structure_fault,
    parse_json,
    read_bounded,
)
from jointfit_daemon.limb_model import Calibration, CalibrationSchemaError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

MOST_BYTES = 64 * 1024 * 1024
"""Size of the largest file that is read. A calibration of four sensors has about 1 MB."""
LAST_VERSION = 999_999_999
"""Largest version number. File names with more than nine digits are not read."""
_NO_LINKS = (errno.EPERM, errno.ENOTSUP)
_NUMBERED = re.compile(r"(\d{4,9})\.json")
_TAKEN = re.compile(r"(\d{4,9})\.json(\.bad\d*)?")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


class CalibrationFileError(Exception):
    """A stored file is damaged or is not a calibration; the message contains file and remedy."""


class _DamagedFileError(CalibrationFileError):
    """The content of the file cannot be used."""


@dataclass(frozen=True, slots=True)
class StoredCalibration:
    """A calibration from the store."""

    calibration: Calibration
    version: int
    notes: tuple[str, ...] = ()
    """One sentence for each newer version that could not be read."""


class CalibrationStore:
    """The versions of the calibration of one name, ``DIRECTORY/NAME/0001.json`` and so on.

    Parameters
    ----------
    directory : Path
        Directory of the store, usually ``$STATE_DIRECTORY/calibrations``. The first write creates
        it.
    name : str
        Name of the subject or session: letters, digits, ``. _ -``, starting with a letter or digit.

    Raises
    ------
    ValueError
        The name contains other characters.
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
        """Return the path of a version, which need not exist."""
        return self._directory / f"{version:04d}.json"

    def save(self, calibration: Calibration) -> int:
        """Write a new version to durable storage and return its number.

        Raises
        ------
        OSError
            The medium is full, read-only or missing, or `LAST_VERSION` exists. The store is then
            unchanged.
        """
        self._directory.mkdir(parents=True, exist_ok=True)
        text = calibration_text(calibration)
        aside = self._directory / f".writing-{os.getpid()}"
        try:
            with aside.open("w", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            version = self._link(aside)
        finally:
            aside.unlink(missing_ok=True)

        descriptor = os.open(self._directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        return version

    def _link(self, aside: Path) -> int:
        """Link the file under the next free number, and return this number.

        Unlike a rename, linking never replaces a file. The file is renamed only if the file system
        has no hard links.
        """
        names = (_TAKEN.fullmatch(path.name) for path in self._directory.iterdir())
        version = max((int(match[1]) for match in names if match), default=0) + 1
        while True:
            if version > LAST_VERSION:
                raise OSError(
                    f"{self._directory}: version {LAST_VERSION} is the last possible number: move"
                    " the file of that number to another directory"
                )
            try:
                os.link(aside, self.path(version))
            except FileExistsError:  # another process used this number
                version += 1
            except OSError as error:
                if error.errno not in _NO_LINKS:
                    raise
                # FAT, for example, has no hard links. Renaming is safe if no other process writes.
                aside.rename(self.path(version))
                return version
            else:
                return version

    def load(self, version: int) -> Calibration:
        """Return one version.

        Raises
        ------
        CalibrationFileError
            The version does not exist, or its file is damaged.
        OSError
            The file cannot be read.
        """
        path = self.path(version)
        if not path.exists():
            known = ", ".join(map(str, self.versions())) or "none"
            raise CalibrationFileError(f"{path}: no such version; stored: {known}")

        # A file with a read error may be readable later, but unusable content remains unusable.
        try:
            data = read_bounded(path, MOST_BYTES)
        except MalformedFileError as error:
            raise CalibrationFileError(str(error)) from error
        try:
            return calibration_of(parse_json(data.decode("utf-8-sig")))
        except (CalibrationSchemaError, ValueError, RecursionError) as error:
            raise _DamagedFileError(
                f"{path}: cannot be used ({str(error) or type(error).__name__:.300}); "
                "restore the file from a backup or calibrate again"
            ) from error

    def latest(self) -> StoredCalibration | None:
        """Return the newest usable version, with a note on every newer version that is unusable.

        Files with unusable content are renamed.

        Raises
        ------
        CalibrationFileError
            Versions exist, but none is usable.
        OSError
            A file cannot be read.
        """
        notes: list[str] = []
        for version in reversed(self.versions()):
            try:
                used = tuple(f"{note}; version {version} is used" for note in notes)
                return StoredCalibration(self.load(version), version, used)
            except _DamagedFileError as error:
                notes.append(f"{error}; {self._set_aside(version)}")
            except CalibrationFileError as error:
                notes.append(str(error))
        if notes:
            raise CalibrationFileError("; ".join(notes))
        return None

    def _set_aside(self, version: int) -> str:
        """Rename a damaged version, so that it is reported once; return a text on the outcome."""
        path = self.path(version)
        for count in range(1, 100):
            aside = path.with_name(f"{path.name}.bad{count if count > 1 else ''}")
            if not aside.exists():
                try:
                    path.rename(aside)
                except OSError as error:
                    return f"it cannot be renamed: {error.strerror}"
                return f"renamed to {aside.name}"
        return "it was not renamed: too many damaged files of this name"


def calibration_text(calibration: Calibration) -> str:
    """Return the text of the file of a calibration; `calibration_of` is the inverse."""
    content = calibration.to_dict()
    table = {"sha256": checksum(content), "calibration": content}
    return json.dumps(table, allow_nan=False, indent=1) + "\n"


def checksum(content: Mapping[str, object]) -> str:
    """Return the SHA-256, in hex, of the canonical JSON form of a calibration."""
    text = json.dumps(content, allow_nan=False, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def calibration_of(table: object) -> Calibration:
    """Return the calibration in the JSON value of a file, which may lack the checksum.

    Raises
    ------
    ValueError, RecursionError
        The content cannot be used. `CalibrationSchemaError` is a ValueError.
    """
    content = None
    if isinstance(table, dict):
        content = table if "schema" in table else table.get("calibration")
    if not isinstance(table, dict) or not isinstance(content, dict):
        raise ValueError("expected a table with sha256 and calibration")  # noqa: TRY004 - file content
    # A file by `jointfit fuse fit` contains only the calibration, without a checksum.
    if content is not table and table.get("sha256") != checksum(content):
        raise ValueError("the checksum differs: the file was damaged or edited")
    if fault := find_structure_fault(content):
        raise ValueError(fault)
    calibration = Calibration.from_dict(content)
    if faults := content_faults(calibration):
        raise ValueError("; ".join(faults))
    return calibration
