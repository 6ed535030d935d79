"""Conversion of a typed text, or of a value from an answer file, to the value of an answer."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Literal

from jointfit_daemon.nearest_name import did_you_mean
from jointfit_daemon.tools.init._answers import split_address

if TYPE_CHECKING:
    from collections.abc import Sequence

Kind = Literal["text", "names", "number", "yes_no", "choice", "device", "address", "ids"]
"""Type of the value that a question expects."""

NEEDED = "an answer is needed here: '?' explains the question, Ctrl-C stores the other answers"
"""Error message if the user types nothing and there is no proposal."""
_YES, _NO = ("y", "yes", "true", "1"), ("n", "no", "false", "0")


class AnswerError(ValueError):
    """An answer cannot be used; the message contains the answer and the expected form."""


def parse_answer(
    kind: Kind, given: Any, choices: Sequence[str] = (), *, optional: bool = False
) -> Any:
    """Return the value of an answer; None for an empty optional answer.

    Parameters
    ----------
    kind
        Type of the value that the question expects.
    given
        A typed text, or a value of TOML.
    choices
        Values of the displayed list. The number of a value in this list, from 1, is also accepted.
    optional
        Whether an empty answer is accepted.

    Raises
    ------
    AnswerError
        `given` cannot be converted to this type.
    """
    if isinstance(given, str):
        given = given.strip()
        if not given.isascii() and any("\ud800" <= letter <= "\udfff" for letter in given):
            raise AnswerError(f"found {given!r}, which is not UTF-8: type it again")
    if given in ("", [], None):
        if optional:
            return () if kind == "names" else None
        raise AnswerError(NEEDED)
    if isinstance(given, dict):
        raise AnswerError("found a table, expected one value")
    return _PARSERS[kind](given, choices)


def _text(given: Any, _choices: Sequence[str]) -> str:
    if not isinstance(given, str):
        raise AnswerError(f"found {given!r}, expected a text")
    return given


def _names(given: Any, _choices: Sequence[str]) -> tuple[str, ...]:
    names = given.split(",") if isinstance(given, str) else given
    if not isinstance(names, Iterable) or not all(isinstance(name, str) for name in names):
        raise AnswerError(f"found {given!r}, expected names, separated by commas")
    found = tuple(name.strip() for name in names)
    if "" in found:
        raise AnswerError("found an empty name, expected names, separated by commas")
    if len(set(found)) < len(found):
        raise AnswerError(f"found a name twice in {', '.join(found)}: expected each name once")
    return found


def _number(given: Any, _choices: Sequence[str]) -> float | int:
    try:
        number = float(given) if not isinstance(given, bool) else math.nan
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise AnswerError(f"found {given!r}, expected a number")
    return int(number) if number == int(number) else number


def _yes_no(given: Any, _choices: Sequence[str]) -> bool:
    word = str(given).lower()
    if word in _YES:
        return True
    if word in _NO:
        return False
    raise AnswerError(f"found {given!r}, expected yes or no")


def _device(given: Any, choices: Sequence[str]) -> str:
    """Return the listed choice if the text is its number; return other texts unchanged."""
    word = str(given)
    if word.isascii() and word.isdigit():
        if not 1 <= int(word) <= len(choices):
            raise AnswerError(f"found the number {word}, the list has {len(choices)} entries")
        return choices[int(word) - 1]
    return _text(given, choices)


def _choice(given: Any, choices: Sequence[str]) -> str:
    if str(given) in choices:  # a number that is itself a choice is not a position in the list
        return str(given)
    chosen = _device(given, choices)
    if chosen not in choices:
        near = did_you_mean(chosen, choices)
        raise AnswerError(f"found {chosen!r}, expected one of {', '.join(choices)}; {near}")
    return chosen


def _address(given: Any, choices: Sequence[str]) -> str:
    chosen = _device(given, choices)
    try:
        host, _ = split_address(chosen)
    except ValueError as error:
        raise AnswerError(str(error)) from None
    if not host:
        raise AnswerError(f"found {chosen!r}, expected HOST or HOST:PORT")
    return chosen


def _ids(given: Any, choices: Sequence[str]) -> tuple[int, ...]:
    """Return CAN identifiers; `choices` are the names of the identifiers."""
    words = given.replace(",", " ").split() if isinstance(given, str) else given
    try:
        numbers = tuple(word if isinstance(word, int) else int(word, 0) for word in words)
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) != len(choices):
        raise AnswerError(
            f"found {given!r}, expected {len(choices)} identifiers ({', '.join(choices)}),"
            f" such as {' '.join(f'{0x105 + at:#x}' for at in range(len(choices)))}"
        )
    return numbers


_PARSERS: dict[Kind, Callable[[Any, Sequence[str]], Any]] = {
    "text": _text,
    "names": _names,
    "number": _number,
    "yes_no": _yes_no,
    "choice": _choice,
    "device": _device,
    "address": _address,
    "ids": _ids,
}
