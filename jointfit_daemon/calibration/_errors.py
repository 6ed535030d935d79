"""Errors of a calibration, with the reason and the remedy for the operator."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.nearest_name import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence


class CalibrationError(Exception):
    """The data are not sufficient for the calibration.

    Parameters
    ----------
    *reasons : str
        One sentence for each problem, with the object, the finding and the remedy.
    """

    def __init__(self, *reasons: str) -> None:
        super().__init__("; ".join(reasons))
        self.reasons: tuple[str, ...] = reasons


def unknown_name(kind: str, name: str, known: Iterable[str], taken: Collection[str] = ()) -> str:
    """Return the message for a name that is not in the stream, with the most similar known name.

    Names in `taken`, which the rig already uses, are not suggested.
    """
    choices: Sequence[str] = sorted(known)
    listed = f"it has: {', '.join(choices) or 'none'}"
    hint = " ".join(
        filter(None, (did_you_mean(name, (each for each in choices if each not in taken)), listed))
    )
    return f"{kind} {name!r} is not in the stream; {hint}"
