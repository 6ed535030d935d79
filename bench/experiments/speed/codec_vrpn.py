"""VRPN: CPU time of codec and decoder per pose; no Python package decodes VRPN for a comparison."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bench.framework.measurement import per_item, speed_experiment
from jointfit_daemon.driver import find_driver
from jointfit_daemon.model import Chunk, MocapFrame
from jointfit_protocols import vrpn

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.framework.experiment import Result

FRAMES = 200
BODIES = 5
PERIOD_US = 8_333
TYPES = {name: number for number, name in enumerate(vrpn.TYPE_NAMES)}
DESCRIPTIONS: list[vrpn.VrpnContent] = [
    *(vrpn.TypeDescription(number, name) for name, number in TYPES.items()),
    *(vrpn.SenderDescription(number, f"Body{number}") for number in range(BODIES)),
]
OPENING = b"".join(vrpn.encode(message) for message in (vrpn.Cookie(), *DESCRIPTIONS))
WIRE = [
    b"".join(
        vrpn.encode(
            vrpn.TrackerPose(PERIOD_US * n, body, 0, 0.1 * body, 1.0, n / 1e3, 0.0, 0.0, 0.6, 0.8),
            TYPES,
        )
        for body in range(BODIES)
    )
    for n in range(1, FRAMES + 1)
]


def rows(quick: bool) -> list[Result]:
    """Measure the codec and the whole decoder with one frame of several bodies per chunk."""
    driver = find_driver("vrpn")
    settings = driver.Settings(driver="vrpn", server="127.0.0.1", up_axis="y")
    chunks = [Chunk(n * PERIOD_US * 1000, data) for n, data in enumerate(WIRE, 1)]
    opening = Chunk(0, OPENING)

    def codec() -> Callable[[], object]:
        fresh = vrpn.VrpnCodec()
        fresh.feed(OPENING)
        return lambda: [fresh.feed(data) for data in WIRE]

    def whole() -> Callable[[], object]:
        fresh = driver(settings).decoder()
        fresh.feed(opening)
        return lambda: [fresh.feed(chunk) for chunk in chunks]

    decoder = driver(settings).decoder()
    decoder.feed(opening)
    given = [item for chunk in chunks for item in decoder.feed(chunk)]
    assert sum(isinstance(item, MocapFrame) for item in given) == FRAMES

    poses, size = FRAMES * BODIES, f"{BODIES} bodies"
    return [
        per_item("vrpn: codec, one pose", codec, items=poses, goal_us=5, quick=quick),
        per_item(
            "vrpn: bytes to MocapFrame", whole, items=FRAMES, goal_us=150, quick=quick, note=size
        ),
    ]


EXPERIMENTS = (speed_experiment("vrpn-codec", "VRPN: codec and decoder", rows),)
