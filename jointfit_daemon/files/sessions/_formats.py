"""Registry of the formats in which sessions are written and read, by name and file extension."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import orjson

from jointfit_daemon.files.orientations import read_orientations_npz
from jointfit_daemon.files.sessions._bids_motion import read_bids_session, write_bids_session
from jointfit_daemon.files.sessions._dot_csv import is_dot_csv, read_dot_session
from jointfit_daemon.files.sessions._foxglove import write_foxglove_session
from jointfit_daemon.files.sessions._marker_files import (
    read_c3d_session,
    read_trc_session,
    write_c3d_session,
    write_trc_session,
)
from jointfit_daemon.files.sessions._mtb_text import is_mtb_text, read_mtb_session
from jointfit_daemon.files.sessions._opensim_files import (
    read_mot_session,
    read_sto_session,
    write_mot_session,
    write_sto_session,
)
from jointfit_daemon.files.sessions._table_files import (
    read_csv_session,
    read_parquet_session,
    write_csv_session,
    write_parquet_session,
)
from jointfit_daemon.files.sessions._written_session import WrittenSession
from jointfit_daemon.files.sessions._xdf import read_xdf_session, write_xdf_session
from jointfit_daemon.files.text import MalformedFileError, reject_device
from jointfit_daemon.session_data import (
    SegmentSeries,
    SensorSeries,
    SessionData,
    SessionDataError,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    Writer = Callable[[SessionData, Path], WrittenSession]

_FORBIDDEN = '/\\:*?"<>|'
"""Characters that some operating systems do not permit in file names."""


@dataclass(frozen=True, slots=True)
class SessionFormat:
    """A format in which sessions can be written."""

    contents: str
    """Description of the content of the files."""
    write: Writer


SESSION_FORMATS: Mapping[str, SessionFormat] = {
    "trc": SessionFormat("markers", write_trc_session),
    "c3d": SessionFormat("markers, events", write_c3d_session),
    "sto": SessionFormat("orientations of sensors and segments", write_sto_session),
    "mot": SessionFormat("joint angles and positions", write_mot_session),
    "csv": SessionFormat("all, as tidy tables", write_csv_session),
    "parquet": SessionFormat("all, as tidy tables", write_parquet_session),
    "xdf": SessionFormat("all, as streams", write_xdf_session),
    "bids-motion": SessionFormat("all, as a data set", write_bids_session),
    "mcap-foxglove": SessionFormat("all, for viewers", write_foxglove_session),
}
"""Formats by their name, which is the argument of the option ``--to``."""


def write_session(
    session: SessionData,
    folder: Path,
    to: str,
    *,
    names: Mapping[str, str] | None = None,
    overwrite: bool = False,
) -> WrittenSession:
    """Write a session in a format: all of its files, or none if an error occurs.

    Parameters
    ----------
    session
        Session to write. The file names begin with the session's name.
    folder
        Existing folder.
    to
        Key of `SESSION_FORMATS`.
    names
        Column names in ``sto`` files, by name of the sensor or segment.
    overwrite
        Whether existing files are replaced.

    Raises
    ------
    NothingToWriteError
        The session contains no data that the format can store.
    FileExistsError
        A file exists and `overwrite` is false.
    MissingPackageError
        The format needs an optional package.
    """
    write = SESSION_FORMATS[to].write
    if to == "sto":
        write = partial(write_sto_session, names=names)
    name = "".join("_" if char in _FORBIDDEN else char for char in session.name).strip(". ")
    session = replace(session, name=name or "session")

    # The files become visible together, after all of them were written completely.
    with tempfile.TemporaryDirectory(prefix=".jointfit-export-", dir=folder) as staging:
        written = write(session, Path(staging))
        entries = [(entry, folder / entry.name) for entry in sorted(Path(staging).iterdir())]
        existing = [target for _, target in entries if target.exists()]
        if existing and not overwrite:
            raise FileExistsError(
                f"{existing[0]} exists: choose another folder, or replace it (--force)"
            )
        for entry, target in entries:
            if target.is_dir():
                shutil.rmtree(target)
            entry.replace(target)
        files = tuple(folder / path.relative_to(staging) for path in written.files)
    return WrittenSession(files, written.notes)


def _read_npz_session(path: Path) -> SessionData:
    """Return the sensors and bones of an NPZ file of orientations; the bones are the reference."""
    trial = read_orientations_npz(path)
    return SessionData(
        path.stem,
        sensors=tuple(SensorSeries(name, "", trial.t_s, q) for name, q in trial.sensors.items()),
        optical_segments=tuple(
            SegmentSeries(name, trial.t_s, q) for name, q in trial.bones.items()
        ),
    )


def _read_csv_file(path: Path) -> SessionData:
    """Return the session of a CSV file, written by `jointfit export` or by a DOT sensor."""
    return read_dot_session([path], path.stem) if is_dot_csv(path) else read_csv_session(path)


def _read_text_session(path: Path) -> SessionData:
    if not is_mtb_text(path):
        raise MalformedFileError(
            f"{path}: not a text file of an Xsens program (no comment lines // and no column"
            " PacketCounter): export the recording as text again"
        )
    return read_mtb_session([path], path.stem)


def _read_folder(path: Path) -> SessionData:
    if any(path.glob("sub-*")):
        return read_bids_session(path)
    texts = [file for file in sorted(path.glob("*.txt")) if is_mtb_text(file)]
    if texts:
        return read_mtb_session(texts, path.name)
    dots = [file for file in sorted(path.glob("*.csv")) if is_dot_csv(file)]
    if dots:
        return read_dot_session(dots, path.name)
    raise MalformedFileError(
        f"{path}: the folder contains neither a Motion-BIDS data set (sub-01) nor text or CSV files"
        " of Xsens programs: name a file"
    )


_READERS: Mapping[str, Callable[[Path], SessionData]] = {
    ".trc": read_trc_session,
    ".c3d": read_c3d_session,
    ".sto": read_sto_session,
    ".mot": read_mot_session,
    ".csv": _read_csv_file,
    ".parquet": read_parquet_session,
    ".xdf": read_xdf_session,
    ".npz": _read_npz_session,
    ".txt": _read_text_session,
}
SESSION_SUFFIXES = tuple(_READERS)
"""File extensions that `read_session` accepts."""


def read_session(path: Path) -> SessionData:
    """Return the session of a file (by its extension) or of a folder (Motion-BIDS or Xsens).

    Raises
    ------
    MalformedFileError
        The file has another format or is damaged, or its times decrease.
    MissingPackageError
        The format needs an optional package.
    """
    reject_device(path)
    suffix = path.suffix.lower()
    if not path.is_dir() and suffix not in _READERS:
        raise MalformedFileError(
            f"{path}: expected a folder or a file that ends in {', '.join(_READERS)}"
        )
    if not path.is_dir() and path.stat().st_size == 0:
        raise MalformedFileError(f"{path}: is empty: copy or export it again")
    read = _read_folder if path.is_dir() else _READERS[suffix]
    try:
        session = read(path)
    except (SessionDataError, orjson.JSONDecodeError) as fault:
        raise MalformedFileError(f"{path}: {fault}") from fault
    return replace(session, description={"file": path.name} | dict(session.description))
