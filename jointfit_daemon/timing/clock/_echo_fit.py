"""Server clock to host clock from answered echoes (Cristian 1989, NTP's minimum-delay filter).

Law: pure; one echo a second makes cost no matter.

An echo sent at a and answered at b with server time u in between says ``theta = u - (a + b)/2``
with an error of at most half the round trip ``rho = b - a``. Echoes near the smallest round trip
are kept, and ``theta(m) = theta_0 + s (m - m_0)`` is fitted to them by weighted least squares with
Huber weights and a prior on s, so that the first seconds give no wild slope. Half the asymmetry of
the path stays in theta_0: ``bound_ns`` says how much that can be at most.

An answer that contradicts the fit is set aside. Only a second one in a row that agrees with it
shows that the server's clock began anew: a single wrong or forged answer changes nothing.
"""

from __future__ import annotations

from collections import deque
from math import inf, sqrt
from typing import NamedTuple

from jointfit_daemon.timing.clock._line_fit import FittedLine, fit_line

MEMORY_NS = 120_000_000_000
CAPACITY = 256
BURST = 10
"""Echoes after which the fit may be used as it is."""
BURST_GAP_NS = 2_000_000_000
"""Echoes further apart than this make no burst that is worth waiting for."""
LEAST_MARGIN_NS = 50_000
STAMP_SD_NS = 20_000.0
SKEW_SD = 50e-6
STALE_NS = 20_000_000_000
JUMP_NS = 5_000_000
"""A server clock that disagrees by more than this, beyond the echo's own bound, began anew."""


class _Echo(NamedTuple):
    middle_ns: int
    theta_ns: int
    round_trip_ns: int


class EchoFit:
    """Line through the echoes of the last two minutes."""

    __slots__ = (
        "_doubtful", "_echoes", "_line", "_ref", "_theta_ref", "bound_ns", "echoes", "slope",
    )  # fmt: skip

    def __init__(self) -> None:
        self._echoes: deque[_Echo] = deque(maxlen=CAPACITY)
        self._doubtful: _Echo | None = None
        self._ref = self._theta_ref = 0
        self._line = FittedLine(0.0, 0.0, inf, 0.0, SKEW_SD**2)
        self.slope = 0.0
        """d theta / d host time: positive when the server clock runs fast."""
        self.bound_ns = inf
        """Hard limit of the unseen constant, half the smallest round trip, ns."""
        self.echoes = 0
        """Echoes taken since the fit began."""

    @property
    def settled(self) -> bool:
        """Whether the connect burst is complete."""
        return self.echoes >= BURST

    @property
    def last_ns(self) -> int | None:
        """Host time of the last echo; None before the first."""
        return self._echoes[-1].middle_ns if self._echoes else None

    def expects_more(self, now_ns: int) -> bool:
        """Tell whether the burst goes on: no worse estimate need be believed meanwhile."""
        last_ns = self.last_ns
        return not self.settled and last_ns is not None and now_ns - last_ns < BURST_GAP_NS

    @property
    def skew_sigma(self) -> float:
        """Standard deviation of ``slope``."""
        return sqrt(self._line.slope_var)

    def contradicts(self, u: int, sent_ns: int, received_ns: int) -> bool:
        """Tell whether an answer cannot come from the clock that was fitted."""
        if not self.settled:
            return False
        middle = (sent_ns + received_ns) // 2
        return abs(u - self.device_ns(middle)) > (received_ns - sent_ns) / 2 + JUMP_NS

    def confirms_restart(self, u: int, sent_ns: int, received_ns: int) -> bool:
        """Take a contradicting answer; return whether it agrees with the one set aside before."""
        middle = (sent_ns + received_ns) // 2
        before = self._doubtful
        self._doubtful = now = _Echo(middle, u - middle, received_ns - sent_ns)
        if before is None:
            return False
        slack_ns = (before.round_trip_ns + now.round_trip_ns) / 2 + JUMP_NS
        return abs(now.theta_ns - before.theta_ns) <= slack_ns

    def feed(self, u: int, sent_ns: int, received_ns: int) -> None:
        """Take one answered echo: host stamps and server time, ns. Impossible ones are ignored."""
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
        """Weighted least squares for (theta, slope) about the mean instant of `kept`."""
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
        """Return the host time of server time `u`, ns: solves ``u = m + theta(m)``."""
        ahead = u - self._ref - self._theta_ref
        return (
            self._ref + ahead - round((self._line.height + self.slope * ahead) / (1.0 + self.slope))
        )

    def sigma_ns(self, host_ns: int) -> float:
        """Return the standard deviation at `host_ns`, ns; inf before any echo."""
        m = host_ns - self._ref
        return sqrt(self._line.variance_at(m))
