"""Nearest valid spelling of an unknown name, and synonyms of keys, for error messages.

Comparison ignores case and uses the similarity ratio of `difflib.SequenceMatcher` (Ratcliff and
Obershelp): twice the number of matching characters over the total number of characters.
"""

from __future__ import annotations

from difflib import get_close_matches
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

_CUTOFF = 0.5
"""Least similarity, 0 to 1, of a suggested spelling: half of the characters agree."""

_SHORT = 3
"""Largest length, characters, of a name that counts as short. For a short name, only names with the
same first character, or with the same characters in another order, are suggested."""


_OTHER_WORDS = {
    "adapter": ("interface", "port", "channel"),
    "address": ("server", "host", "port"),
    "baudrate": ("baud", "bitrate"),
    "bitrate": ("baud",),
    "broker": ("host",),
    "bus": ("can", "channel"),
    "comport": ("port",),
    "device": ("port", "can", "channel"),
    "family": ("driver",),
    "folder": ("store",),
    "fps": ("rate_hz", "output_rate_hz"),
    "frequency": ("rate_hz", "output_rate_hz"),
    "host": ("server",),
    "hostname": ("server", "host"),
    "hz": ("rate_hz", "output_rate_hz"),
    "ip": ("server", "host"),
    "limb": ("segment", "segments"),
    "login": ("username",),
    "model": ("driver",),
    "name": ("id",),
    "odr": ("rate_hz",),
    "password": ("password_file",),
    "path": ("port",),
    "placement": ("segment",),
    "rate": ("rate_hz", "output_rate_hz"),
    "rigidbodies": ("rigid_body",),
    "samplerate": ("rate_hz", "output_rate_hz"),
    "samplingrate": ("rate_hz", "output_rate_hz"),
    "serial": ("port",),
    "serialport": ("port",),
    "server": ("host",),
    "speed": ("baud", "bitrate"),
    "topic": ("base",),
    "tty": ("port",),
    "type": ("driver",),
    "up": ("up_axis",),
    "updaterate": ("rate_hz", "output_rate_hz"),
    "url": ("server", "host"),
    "user": ("username",),
    "vertical": ("up_axis",),
    "zaxis": ("up_axis",),
}
"""Keys of rig.toml for each synonym. Synonyms are in lower case without separators. The first of
these keys that the table permits is suggested."""


def nearest_key(key: object, known: Iterable[str]) -> str | None:
    """Return the key of `known` that `key` probably means; None if there is none.

    A key of `known` that differs from `key` only in case and separators takes precedence over a
    synonym.
    """
    keys = [other for other in known if other != key]
    folded = _without_separators(str(key))
    same = (other for other in keys if _without_separators(other) == folded)
    others = (other for other in _OTHER_WORDS.get(folded, ()) if other in keys)
    return next(same, None) or next(others, None) or nearest_name(key, keys)


def _without_separators(key: str) -> str:
    return key.casefold().replace("_", "").replace("-", "").replace(" ", "")


def nearest_names(name: object, known: Iterable[str], *, count: int = 1) -> list[str]:
    """Return up to `count` names of `known` that resemble `name`, the most similar first.

    `name` itself is never returned. A value that is not text is compared by its `str`.
    """
    wanted = str(name)
    folded = wanted.casefold()
    by_folded = {other.casefold(): other for other in known if other != wanted}
    if len(folded) <= _SHORT:  # here, a single equal character would reach `_CUTOFF`
        candidates = [
            other
            for other in by_folded
            if other[:1] == folded[:1] or sorted(other) == sorted(folded)
        ]
    else:
        candidates = list(by_folded)
    found = get_close_matches(folded, candidates, n=count, cutoff=_CUTOFF)
    return [by_folded[similar] for similar in found]


def nearest_name(name: object, known: Iterable[str]) -> str | None:
    """Return the name of `known` that resembles `name` most, or None if none is similar."""
    return next(iter(nearest_names(name, known)), None)


def did_you_mean(name: object, known: Iterable[str], *, count: int = 1) -> str:
    """Return the question ``did you mean 'NAME'?``, or an empty string if no name is similar."""
    near = nearest_names(name, known, count=count)
    return f"did you mean {' or '.join(map(repr, near))}?" if near else ""


def unknown_name(
    kind: str, name: str, known: Iterable[str], *, candidates: Iterable[str] | None = None
) -> str:
    """Return an error message for an unknown name: nearest spelling, then all known names.

    `candidates` are the names that may be suggested, `known` by default.
    """
    names = list(known)
    hint = did_you_mean(name, names if candidates is None else candidates)
    listed = f"known: {', '.join(names) or 'none'}"
    return f"no {kind} {name!r}; {hint} {listed}" if hint else f"no {kind} {name!r}; {listed}"
