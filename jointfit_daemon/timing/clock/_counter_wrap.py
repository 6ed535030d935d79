"""Unwrapping of counters that restart at zero.

A counter with `modulus` values determines the count up to a multiple of the modulus. A *turn* is
one cycle of the counter through all values. If two readings are close in time, the change is
assumed to be less than half a turn in either direction. After a longer silence the number of turns
is computed from the elapsed host time.
"""

from __future__ import annotations

_QUARTER = 4
"""If more than 1/4 turn has elapsed, host time determines the number of turns."""


def unwrap(raw: int, last: int, modulus: int | None, elapsed_ns: int, turn_ns: int) -> int:
    """Return the unwrapped count for the reading `raw`.

    Parameters
    ----------
    raw : int
        Count as read, in [0, modulus).
    last : int
        Unwrapped count of the previous reading.
    modulus : int or None
        Number of counter values. None for a counter that never wraps; `raw` is then returned.
    elapsed_ns : int
        Host time between the two arrivals, ns.
    turn_ns : int
        Duration of one whole turn, ns.

    Returns
    -------
    int
        Unwrapped count. It is below `last` if the reading is older than the previous reading.
    """
    if modulus is None:
        return raw

    forward = (raw - last) % modulus
    if _QUARTER * elapsed_ns > turn_ns:
        turns = round((elapsed_ns - forward * turn_ns / modulus) / turn_ns)
        return last + forward + max(turns, -1) * modulus
    return last + (forward - modulus if 2 * forward >= modulus else forward)
