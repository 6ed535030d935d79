"""Answer files, which store an interrupted dialogue or contain the input of a script.

A question that is asked once has a key. A question that is asked for several subjects has a table
with a key for each subject::

    limb = "knee"
    [sensors]
    thigh = ["thigh-front", "thigh-side"]
"""

from __future__ import annotations

import tomllib
from typing import TYPE_CHECKING, Any

from jointfit_daemon.files.text import toml_key, toml_value
from jointfit_daemon.tools.output_files import replace_file

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from jointfit_daemon.tools.init._answers import Answers, Key

_HEADER = "# Answers of an unfinished `jointfit init`, which continues with them.\n"


def read_answers(path: Path) -> Answers:
    """Return the answers in a file; their values are not checked.

    Raises
    ------
    ValueError
        The file is not valid TOML in UTF-8.
    OSError
        The file cannot be read.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: invalid answer file: {error}: expected TOML in UTF-8") from error
    answers: Answers = {}
    for key, value in table.items():
        if isinstance(value, dict):
            answers |= {(key, subject): answer for subject, answer in value.items()}
        else:
            answers[key, ""] = value
    return answers


def write_answers(path: Path, answers: Mapping[Key, Any]) -> None:
    """Write `answers`; an existing file is replaced atomically."""
    tables: dict[str, list[str]] = {"": []}
    for (key, subject), value in answers.items():
        # TOML has no null, so an empty text represents the empty answer.
        text = toml_value("" if value is None else value)
        if subject:
            tables.setdefault(key, []).append(f"{toml_key(subject)} = {text}")
        else:
            tables[""].append(f"{key} = {text}")
    parts = [f"[{key}]\n" * bool(key) + "\n".join(lines) + "\n" for key, lines in tables.items()]
    replace_file(path, _HEADER + "\n".join(parts))
