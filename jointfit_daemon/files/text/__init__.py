"""Text files read within bounds: TOML, JSON and tables of numbers."""

from jointfit_daemon.files.text._structured import (
    DEEPEST,
    parse_json,
    parse_toml,
    plain_fault,
    read_bounded,
    read_json,
    read_text,
    read_toml,
)
from jointfit_daemon.files.text._tables import (
    Malformed,
    cells_of,
    number,
    read_lines,
    refuse_device,
    refuse_vast,
    require_times,
    rows_of_numbers,
    separator_of,
    without_trailing_blanks,
    written,
)

__all__ = [
    "DEEPEST",
    "Malformed",
    "cells_of",
    "number",
    "parse_json",
    "parse_toml",
    "plain_fault",
    "read_bounded",
    "read_json",
    "read_lines",
    "read_text",
    "read_toml",
    "refuse_device",
    "refuse_vast",
    "require_times",
    "rows_of_numbers",
    "separator_of",
    "without_trailing_blanks",
    "written",
]
