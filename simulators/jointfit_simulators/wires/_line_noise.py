"""Serial line noise: flipped bits and bursts of random bytes.

Invariant: a flip preserves the number of bytes, and a burst is inserted between bytes. With zero
noise, the data are unchanged.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_simulators.imu_device import WireNoise, clean_wire

if TYPE_CHECKING:
    from jointfit_simulators.settings import Knobs


def line_noise(knobs: Knobs, name: str) -> WireNoise:
    """Return the noise function for the serial line of one device."""
    if not (knobs.line_flip_per_byte or knobs.line_burst_per_byte):
        return clean_wire
    random = knobs.random(f"line {name}")

    def noisy(data: bytes) -> bytes:
        flips = random.random(len(data)) < knobs.line_flip_per_byte
        bursts = random.random(len(data)) < knobs.line_burst_per_byte
        if not (flips.any() or bursts.any()):
            return data

        out = bytearray()
        for byte, flipped, burst in zip(data, flips, bursts, strict=True):
            if burst:
                out += random.bytes(int(random.integers(1, knobs.line_burst_bytes + 1)))
            out.append(byte ^ (1 << int(random.integers(8))) if flipped else byte)
        return bytes(out)

    return noisy
