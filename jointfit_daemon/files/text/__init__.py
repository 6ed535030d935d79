"""Reading of TOML, JSON and tables of numbers with limited memory; writing of TOML values."""

from jointfit_daemon.files.text._structured import (
    MAX_NESTING,
    find_structure_fault,
    parse_json,
    parse_toml,
    read_bounded,
    read_json,
    read_text,
    read_toml,
)
from jointfit_daemon.files.text._tables import (
    MalformedFileError,
    cells_of,
    format_instant,
    format_value,
    number,
    read_columns,
    read_lines,
    reject_device,
    reject_sparse_table,
    require_times,
    rows_of_numbers,
    separator_of,
    strip_trailing_empty,
)
from jointfit_daemon.files.text._toml_text import toml_key, toml_value

__all__ = [
    "MAX_NESTING",
    "MalformedFileError",
    "cells_of",
    "find_structure_fault",
    "format_instant",
    "format_value",
    "number",
    "parse_json",
    "parse_toml",
    "read_bounded",
    "read_columns",
    "read_json",
    "read_lines",
    "read_text",
    "read_toml",
    "reject_device",
    "reject_sparse_table",
    "require_times",
    "rows_of_numbers",
    "separator_of",
    "strip_trailing_empty",
    "toml_key",
    "toml_value",
]
