"""Sessions as tidy tables in files ``NAME_TABLE.csv`` or ``NAME_TABLE.parquet``.

To read a session, pass any one of its files; the others are read from the same folder.
"""

from __future__ import annotations

import csv
from math import isnan
from typing import TYPE_CHECKING, Any

import numpy as np
import orjson

from jointfit_daemon.files.sessions._missing_extra import import_extra
from jointfit_daemon.files.sessions._tidy_tables import (
    TABLES,
    TEXT_COLUMNS,
    session_of_tables,
    tables_of,
)
from jointfit_daemon.files.sessions._written_session import WrittenSession
from jointfit_daemon.files.text import MalformedFileError, number, read_lines

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from jointfit_daemon.files.sessions._tidy_tables import Table
    from jointfit_daemon.session_data import SessionData

_BLOCK_ROWS = 1 << 15
"""Number of rows that are converted to text at a time, which limits the use of memory."""
MOST_VALUES = 1 << 27
"""Largest number of values that are read from a file; this number takes 1 GiB of memory."""
_NEEDS_QUOTES = frozenset(',"\n\r')


def write_csv_session(session: SessionData, folder: Path) -> WrittenSession:
    """Write the tables as CSV.

    Column names contain units. Numbers have 9 significant digits, and times have a resolution of
    1 ns.
    """
    files = []
    for name, table in tables_of(session).items():
        path = folder / f"{session.name}_{name}.csv"
        count = len(next(iter(table.values())))
        with path.open("w", encoding="utf-8", newline="") as file:
            file.write(",".join(table) + "\n")
            for k in range(0, count, _BLOCK_ROWS):
                rows = slice(k, k + _BLOCK_ROWS)
                cells = [_texts_of(column, values[rows]) for column, values in table.items()]
                file.writelines(f"{','.join(row)}\n" for row in zip(*cells, strict=True))
        files.append(path)
    return WrittenSession(tuple(files))


def _texts_of(name: str, values: NDArray[Any]) -> list[str]:
    if name in TEXT_COLUMNS:
        quoted = {
            text: f'"{text.replace(chr(34), 2 * chr(34))}"' if _NEEDS_QUOTES & set(text) else text
            for text in set(values.tolist())
        }
        return [quoted[text] for text in values.tolist()]
    form = "{:.9f}" if name == "t_s" else "{:.9g}"
    return ["" if isnan(value) else form.format(value) for value in values.tolist()]


def read_csv_session(path: Path) -> SessionData:
    """Return the session of a CSV file of `write_csv_session` and of the files next to it.

    Raises
    ------
    MalformedFileError
        The file contains another table, lacks columns, or has a cell that is not a number.
    """
    return _read_session(path, ".csv", _read_csv)


def _read_csv(path: Path, columns: Sequence[str]) -> Table:
    rows = list(csv.reader(f"{line}\n" for line in read_lines(path)))
    if not rows or rows[0] != list(columns):
        found = ",".join(rows[0])[:80] if rows else "nothing"
        raise MalformedFileError(
            f"{path}, line 1: found {found}, expected the columns {','.join(columns)}: export the"
            " session again"
        )
    short = next((k for k, row in enumerate(rows) if len(row) != len(columns)), None)
    if short is not None:
        raise MalformedFileError(
            f"{path}, row {short + 1}: {len(rows[short])} cells, expected {len(columns)}: the file"
            " is cut off or was edited; export it again"
        )
    table: Table = {}
    cells = list(zip(*rows[1:], strict=True)) or [()] * len(columns)
    for name, texts in zip(columns, cells, strict=True):
        if name in TEXT_COLUMNS:
            table[name] = np.array(texts, dtype=object)
        else:
            try:
                table[name] = np.array([text or "nan" for text in texts], dtype=np.float64)
            except ValueError:  # `number` raises an error that names the wrong cell
                numbers = [number(path, k, text) for k, text in enumerate(texts, start=2)]
                table[name] = np.array(numbers)
    return table


def write_parquet_session(session: SessionData, folder: Path) -> WrittenSession:
    """Write the tables as Parquet. Unknown values are null; texts are encoded as dictionaries.

    Raises
    ------
    MissingPackageError
        The package pyarrow is not installed.
    """
    arrow, parquet = import_extra("pyarrow", "parquet"), import_extra("pyarrow.parquet", "parquet")
    files = []
    for name, table in tables_of(session).items():
        columns = {
            column: arrow.array(values, arrow.string()).dictionary_encode()
            if column in TEXT_COLUMNS
            else arrow.array(values, from_pandas=True)
            for column, values in table.items()
        }
        path = folder / f"{session.name}_{name}.parquet"
        facts = {"start_unix_ns": session.start_unix_ns, "name": session.name}
        whole = arrow.table(columns).replace_schema_metadata({"jointfit": orjson.dumps(facts)})
        parquet.write_table(whole, path, compression="zstd")
        files.append(path)
    return WrittenSession(tuple(files))


def read_parquet_session(path: Path) -> SessionData:
    """Return the session of a file of `write_parquet_session` and of the files next to it.

    Raises
    ------
    MalformedFileError
        The file is not a Parquet file, or contains another table.
    MissingPackageError
        The package pyarrow is not installed.
    """
    arrow, parquet = import_extra("pyarrow", "parquet"), import_extra("pyarrow.parquet", "parquet")

    def read(file: Path, columns: Sequence[str]) -> Table:
        try:
            # Texts are read as dictionaries, so that a repeated long text is stored only once.
            texts = [name for name in columns if name in TEXT_COLUMNS]
            with parquet.ParquetFile(file, read_dictionary=texts) as opened:
                _check_parquet(file, opened.schema_arrow.names, opened.metadata, columns)
                found = opened.read().unify_dictionaries().combine_chunks()
        except (arrow.ArrowException, OSError) as fault:
            raise MalformedFileError(
                f"{file}: not a Parquet file, or cut off: export it again"
            ) from fault
        return {
            name: _texts_in(file, name, found[name])
            if name in TEXT_COLUMNS
            else found[name].to_numpy().astype(np.float64)
            for name in columns
        }

    return _read_session(path, ".parquet", read)


def _check_parquet(file: Path, names: list[str], metadata: Any, columns: Sequence[str]) -> None:
    """Reject unexpected columns, and more than `MOST_VALUES` values, before the file is read.

    Repeated values take no space in a Parquet file, so a few bytes can represent any number of
    rows.
    """
    if names != list(columns):
        raise MalformedFileError(
            f"{file}: found the columns {', '.join(names)[:200]}, expected"
            f" {', '.join(columns)}: export the session again"
        )
    if metadata.num_rows * len(columns) > MOST_VALUES:
        raise MalformedFileError(
            f"{file}: declares {metadata.num_rows} rows of {len(columns)} columns, at most"
            f" {MOST_VALUES} values are read: split the session"
        )


def _texts_in(file: Path, name: str, column: Any) -> NDArray[Any]:
    """Return the texts of a dictionary-encoded column; equal texts are one object."""
    found = [
        np.array([*chunk.dictionary.to_pylist(), None], dtype=object)[
            chunk.indices.fill_null(-1).to_numpy(zero_copy_only=False)
        ]
        for chunk in column.chunks
        if hasattr(chunk, "dictionary")
    ]
    if len(found) != len(column.chunks):
        raise MalformedFileError(f"{file}: column {name} has no texts: export the session again")
    return np.concatenate(found) if found else np.array([], dtype=object)


def _read_session(
    path: Path, suffix: str, read: Callable[[Path, Sequence[str]], Table]
) -> SessionData:
    name, _, table = path.stem.rpartition("_")
    if table not in TABLES or not name:
        raise MalformedFileError(
            f"{path}: expected a name that ends in _{f'{suffix}, _'.join(TABLES)}{suffix}, as"
            " jointfit export writes it"
        )
    files: Mapping[str, Path] = {
        table: file
        for table in TABLES
        if (file := path.with_name(f"{name}_{table}{suffix}")).exists()
    }
    tables = {table: read(file, TABLES[table]) for table, file in files.items()}
    return session_of_tables(tables, name)
