"""What a calibration says when it will not answer.

Law: every sentence names the thing, what was found and the remedy.
"""

from __future__ import annotations

from difflib import get_close_matches
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence


class CalibrationRefused(Exception):  # noqa: N818 - named for what happened, as CONVENTIONS.md asks
    """The data cannot give what was asked for; every reason found, each with its remedy.

    Parameters
    ----------
    *reasons : str
        One sentence each: the thing, what was found, what to do.
    """

    def __init__(self, *reasons: str) -> None:
        super().__init__("; ".join(reasons))
        self.reasons: tuple[str, ...] = reasons


def unknown_name(kind: str, name: str, known: Iterable[str]) -> str:
    """Return the sentence for a name the stream does not have, with the nearest spelling."""
    choices: Sequence[str] = sorted(known)
    folded = {choice.casefold(): choice for choice in choices}
    near = get_close_matches(name.casefold(), list(folded), n=1)
    hint = f"did you mean {folded[near[0]]!r}? " if near else ""
    return f"{kind} {name!r} is not in the stream; {hint}it has: {', '.join(choices) or 'none'}"
