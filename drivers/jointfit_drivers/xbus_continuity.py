"""Counter and clock of an Xbus device: what was lost, and whether it restarted.

Law: integers in, verdicts out. Loss is counted over all MTData2 messages, for every one of them
takes a counter value; time is judged on messages with an orientation only, for others may carry
foreign time (GNSS).

| time step d, counter step c                                   | verdict                      |
|---------------------------------------------------------------|------------------------------|
| d < 0, d + modulus plausible and in keeping with c            | wrap                         |
| d > 1.5 periods, in keeping with c, or no counter             | gap, same clock              |
| d < 0 otherwise; d > 1.5 periods and c contradicts            | restart                      |

"In keeping" means within 2 % and a few counts of what the stream did so far, modulo the width of
the counter: the nominal rate is never trusted further than the first samples.
"""

from __future__ import annotations

from typing import NamedTuple

from jointfit_protocols.xbus_messages import TICK_NS, WRAP_32_BIT, WRAP_DAY

_COUNTS = 1 << 16
_GAP = 1.5
_PLAUSIBLE_GAP = 3600 * 1_000_000_000 // TICK_NS  # an hour: no stall or stale buffer is older
_SLACK_COUNTS = 4
_SLACK_SHARE = 0.02
_LEARNED = 10  # counts after which the stream knows its own rate


class Step(NamedTuple):
    """What happened since the previous orientation."""

    lost: int
    """Messages lost on the way."""
    restarted: bool


_GOES_ON = Step(0, restarted=False)


class Continuity:
    """Follows one device.

    Parameters
    ----------
    rate_hz
        Nominal rate, used until the stream has shown its own.
    """

    def __init__(self, rate_hz: float) -> None:
        self.modulus: int | None = None
        """Ticks after which time starts again; None until the model or a wrap tells."""
        self._nominal = 1_000_000_000 / TICK_NS / rate_hz
        self._last_count: int | None = None
        self._lost = 0
        self._since = 0  # counts since the previous orientation, as the counter says
        self._ticks: int | None = None
        self._sum_ticks = self._sum_counts = 0

    def message(self, counter: int) -> None:
        """Take the counter of any MTData2."""
        last, self._last_count = self._last_count, counter
        if last is None:
            return
        step = (counter - last) % _COUNTS
        self._since += step
        if step > 1:
            self._lost += step - 1

    def orientation(self, ticks: int | None) -> Step:
        """Take the time of a message with an orientation, its counter having been taken."""
        lost, since = self._lost, self._since
        self._lost = self._since = 0
        last = self._ticks
        if ticks is None:
            return Step(lost, restarted=False)
        self._ticks = ticks
        if last is None:
            return Step(lost, restarted=False)
        step = ticks - last
        if step < 0:
            step = self._wrapped(step, since)
        if step < 0 or (step > _GAP * self._period and not self._agree(step, since)):
            self._sum_ticks = self._sum_counts = 0
            return Step(0, restarted=True)
        self._sum_ticks += step
        self._sum_counts += since
        return Step(lost, restarted=False) if lost else _GOES_ON

    def forget(self) -> None:
        """Begin anew: the device said itself that it restarted."""
        self._last_count = self._ticks = None
        self._lost = self._since = self._sum_ticks = self._sum_counts = 0

    @property
    def _period(self) -> float:
        """Ticks a count."""
        if self._sum_counts < _LEARNED:
            return self._nominal
        return self._sum_ticks / self._sum_counts

    def _wrapped(self, step: int, since: int) -> int:
        """Return the step with the wrap undone; `step` itself if it was none."""
        moduli = (WRAP_DAY, WRAP_32_BIT) if self.modulus is None else (self.modulus,)
        for modulus in moduli:
            true = step + modulus
            if 0 < true <= _PLAUSIBLE_GAP and self._agree(true, since):
                self.modulus = modulus
                return true
        return step

    def _agree(self, ticks: int, counts: int) -> bool:
        """Whether `ticks` and `counts` passed together, as far as the counter can tell."""
        if self._last_count is None:
            return True
        expected = round(ticks / self._period)
        off = (counts - expected) % _COUNTS
        return min(off, _COUNTS - off) <= _SLACK_COUNTS + _SLACK_SHARE * expected
