"""Counters that start again at zero. Law: integers only; one function, no state.

A counter of `modulus` values tells its true count only up to whole turns. Neighbours settle the
rest: two readings closer than half a turn are told apart by sign; over a longer silence the
arrival times say how many turns passed unseen.
"""

from __future__ import annotations

_QUARTER = 4


def unwrap(raw: int, last: int, modulus: int | None, elapsed_ns: int, turn_ns: int) -> int:
    """Return the true count whose remainder is `raw`, given the true count before it.

    Parameters
    ----------
    raw : int
        Count as read, in [0, modulus).
    last : int
        True count of the previous reading (its remainder is what was read then).
    modulus : int or None
        Values of the counter; None if it never starts again: `raw` is returned.
    elapsed_ns : int
        Host time between the two arrivals, ns.
    turn_ns : int
        Time of one whole turn, ns.

    Returns
    -------
    int
        Below `last` when the reading is a reordered older one.
    """
    if modulus is None:
        return raw
    forward = (raw - last) % modulus
    if _QUARTER * elapsed_ns > turn_ns:
        turns = round((elapsed_ns - forward * turn_ns / modulus) / turn_ns)
        return last + forward + max(turns, -1) * modulus
    return last + (forward - modulus if 2 * forward >= modulus else forward)
