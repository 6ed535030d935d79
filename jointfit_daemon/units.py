"""Factors of conversions between units.

`NS_PER_S` and `NS_PER_MS` are integers, so that nanoseconds divided by them are rounded once.
"""

from __future__ import annotations

from typing import Final

NS_PER_S: Final = 1_000_000_000
"""Nanoseconds per second."""
NS_PER_MS: Final = 1_000_000
"""Nanoseconds per millisecond."""
S_PER_NS: Final = 1e-9
"""Seconds per nanosecond. Code that runs for every sample multiplies, because a division takes
longer."""
S_PER_US: Final = 1e-6
"""Seconds per microsecond."""
MM_PER_M: Final = 1000.0
"""Millimetres per metre."""
M_PER_MM: Final = 1e-3
"""Metres per millimetre."""
STANDARD_GRAVITY: Final = 9.80665
"""Standard acceleration of gravity, m/s^2 (ISO 80000-3). Devices use it as the unit ``g``."""
