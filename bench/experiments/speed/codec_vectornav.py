"""VectorNav: CPU time of codec and decoder per output.

No package on PyPI reads binary outputs, so there is no comparison. The package `vectornav-vn200`
requests single registers as text.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from bench.framework.measurement import per_item, speed_experiment
from jointfit_daemon.driver import find_driver
from jointfit_daemon.model import Chunk, ImuSample
from jointfit_protocols import vectornav
from jointfit_protocols.vectornav import Field

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.framework.experiment import Result

N = 500
PERIOD_NS = 5_000_000
OUTPUTS = [
    vectornav.encode_binary(
        {Field.TIME_STARTUP: (k * PERIOD_NS,), Field.QUATERNION: (-0.5, 0.1, 0.7, 0.5)}
    )
    for k in range(N)
]


def rows(quick: bool) -> list[Result]:
    """Measure the codec and the whole decoder with one output per chunk."""
    driver = find_driver("vectornav")
    settings = driver.Settings(id="S1", segment="thigh", driver="vectornav", port="p", rate_hz=200)
    chunks = [Chunk(k * PERIOD_NS, data) for k, data in enumerate(OUTPUTS)]
    decoder = driver(settings).decoder()
    given = [item for chunk in chunks for item in decoder.feed(chunk)]
    assert sum(isinstance(item, ImuSample) for item in given) == N

    def codec() -> Callable[[], object]:
        fresh = vectornav.VectorNavCodec()
        return lambda: [fresh.feed(data) for data in OUTPUTS]

    def whole() -> Callable[[], object]:
        fresh = driver(settings).decoder()
        return lambda: [fresh.feed(chunk) for chunk in chunks]

    return [
        per_item("vectornav: codec, one output", codec, items=N, goal_us=5, quick=quick),
        per_item("vectornav: bytes to SI sample", whole, items=N, goal_us=18, quick=quick),
    ]


EXPERIMENTS = (speed_experiment("vectornav-codec", "VectorNav: codec and decoder", rows),)
