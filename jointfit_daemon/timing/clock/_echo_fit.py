"""Server clock offset and skew from echoes (Cristian 1989; NTP's minimum-delay filter).

An echo is sent at host time a, answered with server time u, and received at host time b. The clock
offset is ``theta = u - (a + b)/2``, with an error of at most half the round-trip time ``rho = b -
a``. The line ``theta(m) = theta_0 + s (m - m_0)`` is fitted to the echoes with round-trip times
near the minimum. m is the host time, m_0 the mean host time of these echoes, and s the skew. The
method is weighted least squares with Huber weights. A prior on the skew s keeps s small in the
first seconds. The error of theta_0 is half the difference between the delays of request and reply;
``bound_ns`` is the limit of this error.

Invariant: a single wrong or forged echo does not change a settled fit. An echo that contradicts the
fit is not used. If the next echo agrees with it, the server clock counts as restarted.
"""

from __future__ import annotations

from collections import deque
from math import inf, sqrt
from typing import NamedTuple

from jointfit_daemon.timing.clock._line_fit import FittedLine, fit_line

MEMORY_NS = 120_000_000_000
"""Time span of the echoes that are fitted, ns."""
CAPACITY = 256
"""Largest number of echoes in memory."""
BURST = 10
"""Number of echoes of the initial burst, after which the fit is used."""
BURST_GAP_NS = 2_000_000_000
"""Longest interval between two echoes of one burst, ns."""
LEAST_MARGIN_NS = 50_000
"""Least tolerance above the minimum round-trip time, ns."""
STAMP_SD_NS = 20_000.0
"""Standard deviation of a host timestamp, ns."""
SKEW_SD = 50e-6
"""Prior standard deviation of the skew, dimensionless."""
STALE_NS = 20_000_000_000
"""Age of the last echo after which the fit is reported as stale, ns."""
JUMP_NS = 5_000_000
"""Difference beyond the error bound of an echo that indicates a jump of the server clock, ns."""


class _Echo(NamedTuple):
    middle_ns: int
    theta_ns: int
    round_trip_ns: int


class EchoFit:
    """Line through the echoes of the last two minutes.

    An echo has the server time `u`, and was sent and received at the host times `sent_ns` and
    `received_ns`, ns.
    """

    __slots__ = (
        "_doubtful", "_echoes", "_line", "_ref", "_theta_ref", "bound_ns", "echoes", "slope",
    )  # fmt: skip

    def __init__(self) -> None:
        self._echoes: deque[_Echo] = deque(maxlen=CAPACITY)
        self._doubtful: _Echo | None = None
        self._ref = self._theta_ref = 0
        self._line = FittedLine(0.0, 0.0, inf, 0.0, SKEW_SD**2)
        self.slope = 0.0
        """Derivative of theta with respect to host time; positive if the server clock runs fast."""
        self.bound_ns = inf
        """Limit of the constant error, which is half the smallest round-trip time, ns."""
        self.echoes = 0
        """Number of echoes since the fit started."""

    @property
    def settled(self) -> bool:
        """Whether the initial burst is complete."""
        return self.echoes >= BURST

    @property
    def last_ns(self) -> int | None:
        """Host time of the last echo, ns; None before the first echo."""
        return self._echoes[-1].middle_ns if self._echoes else None

    def expects_more(self, now_ns: int) -> bool:
        """Return whether the initial burst is still in progress."""
        last_ns = self.last_ns
        return not self.settled and last_ns is not None and now_ns - last_ns < BURST_GAP_NS

    @property
    def skew_sigma(self) -> float:
        """Standard deviation of ``slope``."""
        return sqrt(self._line.slope_var)

    def contradicts(self, u: int, sent_ns: int, received_ns: int) -> bool:
        """Return whether an echo contradicts the fit by `JUMP_NS` more than its error bound."""
        if not self.settled:
            return False
        middle = (sent_ns + received_ns) // 2
        return abs(u - self.device_ns(middle)) > (received_ns - sent_ns) / 2 + JUMP_NS

    def confirms_restart(self, u: int, sent_ns: int, received_ns: int) -> bool:
        """Store a contradicting echo; return whether the contradicting echo before it agrees."""
        middle = (sent_ns + received_ns) // 2
        before = self._doubtful
        self._doubtful = now = _Echo(middle, u - middle, received_ns - sent_ns)
        if before is None:
            return False
        slack_ns = (before.round_trip_ns + now.round_trip_ns) / 2 + JUMP_NS
        return abs(now.theta_ns - before.theta_ns) <= slack_ns

    def feed(self, u: int, sent_ns: int, received_ns: int) -> None:
        """Add an echo with server time and host timestamps, ns; an impossible echo is ignored."""
        if received_ns < sent_ns:
            return
        middle = (sent_ns + received_ns) // 2
        self._doubtful = None
        echoes = self._echoes
        echoes.append(_Echo(middle, u - middle, received_ns - sent_ns))
        self.echoes += 1
        while echoes[0].middle_ns < middle - MEMORY_NS:
            echoes.popleft()

        least = min(echo.round_trip_ns for echo in echoes)
        self.bound_ns = least / 2
        limit = least + max(LEAST_MARGIN_NS, least // 4)
        self._fit([echo for echo in echoes if echo.round_trip_ns <= limit], least)

    def _fit(self, kept: list[_Echo], least: int) -> None:
        """Fit (theta, slope) about the mean instant of `kept` by weighted least squares."""
        ref = sum(echo.middle_ns for echo in kept) // len(kept)
        theta_ref = kept[0].theta_ns
        rows = [
            (
                float(echo.middle_ns - ref),
                float(echo.theta_ns - theta_ref),
                1.0 / (STAMP_SD_NS**2 + ((echo.round_trip_ns - least) / 2) ** 2),
            )
            for echo in kept
        ]

        self._ref, self._theta_ref = ref, theta_ref
        self._line = fit_line(rows, SKEW_SD)
        self.slope = self._line.slope

    def device_ns(self, host_ns: int) -> int:
        """Return the server time at a host instant, ns."""
        theta = self._line.height + self.slope * (host_ns - self._ref)
        return host_ns + self._theta_ref + round(theta)

    def host_ns(self, u: int) -> int:
        """Return the host time m of server time `u`, ns, from ``u = m + theta(m)``."""
        ahead = u - self._ref - self._theta_ref
        return (
            self._ref + ahead - round((self._line.height + self.slope * ahead) / (1.0 + self.slope))
        )

    def sigma_ns(self, host_ns: int) -> float:
        """Return the standard deviation of ``device_ns(host_ns)``, ns; inf before any echo."""
        m = host_ns - self._ref
        return sqrt(self._line.variance_at(m))
