"""Command `jointfit export`: writes a recording or a trial file in a format of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jointfit_daemon.tools.activity import show_activity
from jointfit_daemon.tools.text_output import check_choice, echo_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.session_data import SessionData

File = Annotated[
    Path,
    typer.Argument(
        help="Recording (.mcap, or its folder), or a file to convert: .trc, .c3d, .sto, .mot,"
        " .npz, .csv, .parquet, .xdf, .txt of an Xsens program, or a folder: Motion-BIDS, Xsens"
        " text."
    ),
]
To = Annotated[
    list[str],
    typer.Option(
        "--to",
        help="Format: trc, c3d, sto, mot, csv, parquet, xdf, bids-motion, mcap-foxglove."
        " Repeatable.",
    ),
]
Out = Annotated[Path, typer.Option("--out", help="Output folder, created if missing.")]
Name = Annotated[
    list[str] | None,
    typer.Option(
        "--name",
        help="Column name in .sto files: S1=femur_r_imu, so that OpenSense finds the body."
        " Repeatable.",
    ),
]
Force = Annotated[bool, typer.Option("--force", help="Replace existing files.")]
Json = Annotated[bool, typer.Option("--json", help="Print the files as one JSON object.")]


def export(
    file: File,
    *,
    to: To,
    out: Out = Path(),
    name: Name = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Write a recording or a trial in formats of OpenSim, pandas, MNE, Foxglove and others.

    The command reports which data are left out or resampled. If the export to a format fails, no
    file of this format is written.
    """
    from jointfit_daemon.files.sessions import SESSION_FORMATS, write_session

    for form in to:
        check_choice("--to", form, [*SESSION_FORMATS])
    with show_activity("reading"):
        session = load_data(file)
    names = _read_names(name or (), session)
    out.mkdir(parents=True, exist_ok=True)
    with show_activity("writing"):
        written = [
            write_session(session, out, form, names=names, overwrite=force)
            for form in dict.fromkeys(to)
        ]

    files = [str(path) for each in written for path in each.files]
    notes = [note for each in written for note in each.notes]
    if json:
        echo_json({"files": files, "notes": notes})
        return
    for note in notes:
        typer.echo(f"note: {note}", err=True)
    for path in files:
        typer.echo(path)


def load_data(file: Path) -> SessionData:
    """Return the session in a recording, in its folder, or in a file or folder to import.

    Raises
    ------
    OSError
        The file does not exist, or cannot be read.
    ValueError
        The file is damaged, or its type is unknown.
    """
    file.stat()  # a wrong path is reported as such, not as a wrong type
    recorded = any(file.glob("*.mcap*")) if file.is_dir() else ".mcap" in file.suffixes
    if recorded:
        from jointfit_daemon.reprocessing import load_session

        return load_session(file)

    from jointfit_daemon.files.sessions import read_session

    return read_session(file)


def _read_names(given: Sequence[str], session: SessionData) -> dict[str, str]:
    """Return the column names that the option ``--name`` sets.

    Raises
    ------
    ValueError
        The text is not ID=NAME, the sensor or segment is unknown, or two of them have the same
        name.
    """
    from jointfit_daemon.nearest_name import unknown_name

    known = [sensor.id for sensor in session.sensors]
    known += [s.name for s in (*session.segments, *session.optical_segments)]
    names: dict[str, str] = {}
    for text in given:
        item, equals, name = text.partition("=")
        if not equals or not name.isprintable() or not name.strip():
            raise ValueError(f"--name {text}: expected ID=NAME, for example S1=femur_r_imu")
        if item not in known:
            raise ValueError(f"--name {text}: {unknown_name('sensor or segment', item, known)}")
        if name in names.values():
            raise ValueError(f"--name {text}: the name {name!r} is given twice: choose another")
        names[item] = name
    return names
