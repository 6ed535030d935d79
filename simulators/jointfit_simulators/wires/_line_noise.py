"""Serial line noise: flipped bits and bursts of random bytes.

Invariant: a flip preserves the number of bytes, a burst is inserted between bytes, and zero noise
returns the data unchanged.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_simulators.imu_device import WireNoise, clean_wire

if TYPE_CHECKING:
    from jointfit_simulators.settings import Knobs


def line_noise(knobs: Knobs, name: str) -> WireNoise:
    """Return the noise of the line of one device, as the knobs want it."""
    flip, burst, longest = (
        knobs.line_flip_per_byte,
        knobs.line_burst_per_byte,
        knobs.line_burst_bytes,
    )
    if not (flip or burst):
        return clean_wire
    random = knobs.random(f"line {name}")

    def noisy(data: bytes) -> bytes:
        flips = random.random(len(data)) < flip
        bursts = random.random(len(data)) < burst
        if not (flips.any() or bursts.any()):
            return data
        out = bytearray()
        for byte, flipped, garbage in zip(data, flips, bursts, strict=True):
            if garbage:
                out += random.bytes(int(random.integers(1, longest + 1)))
            out.append(byte ^ (1 << int(random.integers(8))) if flipped else byte)
        return bytes(out)

    return noisy
