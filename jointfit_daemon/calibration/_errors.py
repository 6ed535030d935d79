"""What a calibration says when it will not answer.

Law: every sentence names the thing, what was found and the remedy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.nearest_name import did_you_mean

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
    listed = f"it has: {', '.join(choices) or 'none'}"
    hint = " ".join(filter(None, (did_you_mean(name, choices), listed)))
    return f"{kind} {name!r} is not in the stream; {hint}"
