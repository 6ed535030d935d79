"""Test of the conformance suite for a decoder that starts while the device streams."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, ClassVar
from unittest import SkipTest

from jointfit_daemon.model import Chunk
from jointfit_simulators._contract_fixtures import DecodingReceiver, expected_text, require
from jointfit_simulators.imu_device import clean_wire

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.driver import Driver

_LATER = 5
"""Number of samples that the decoder which starts later must return."""


class LateStartContract:
    """Part of `jointfit_simulators.driver_contract.DriverContract`."""

    has_history: ClassVar[bool] = False
    """Whether a sample depends on many earlier samples, for example through a filter."""

    def test_a_decoder_that_starts_later_needs_the_description(self: Any, tmp_path: Path) -> None:
        """A decoder that starts late returns all samples, if it first receives the description.

        The description is the attribute `description` of the first decoder: the newest messages on
        which the decoding of the data depends. See `decode_later` for decoders without it.
        """
        if self.has_history:
            raise SkipTest("the orientation filter begins again")

        async def scene() -> None:
            device, driver = self.make_device(tmp_path, clean_wire), self.make_driver(tmp_path)
            async with self.streaming(device, driver) as (receiver, first):
                numbers = (await self._send_all(device, receiver, first, 20))[-_LATER:]

            found = decode_later(driver, receiver, _LATER)
            require(len(found) == len(numbers), "the later decoder must return all samples")
            for number, item in zip(numbers, found, strict=True):
                require(self.matches(number, item), expected_text(item, number))

        asyncio.run(scene())


def decode_later(driver: Driver, receiver: DecodingReceiver, count: int) -> list[Any]:
    """Return the last `count` measurements from a decoder that receives only the last chunks.

    Before these chunks, the new decoder receives the attribute `description` of the first decoder.
    If the first decoder has no such attribute, the new decoder receives the chunks before the first
    measurement instead.
    """
    again, opening, begin = receiver.restarted(driver), [], 0
    for place, chunk in enumerate(receiver.chunks):
        if len(receiver.measurements) - len(again.measurements) > count:
            begin = place
        again.emit(chunk)
        if not again.measurements:
            opening.append(chunk.data)

    later = receiver.restarted(driver)
    for data in getattr(receiver.decoder, "description", opening):
        later.emit(Chunk(receiver.chunks[begin].t_ns, data))
    for chunk in receiver.chunks[begin:]:
        later.emit(chunk)
    return later.measurements[-count:]
