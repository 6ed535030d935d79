"""Driver of Xsens MTi-600, Sirius and Avior IMUs on CAN ("XCDI").

The driver only receives. The user configures the device once over its UART, because CAN is switched
off by factory default. The driver cannot send requests or settings over CAN, so it only reports a
fault with its remedy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field
from typing_extensions import override

from jointfit_daemon.driver import Settings, Wire
from jointfit_drivers.can_imu import CanImuSettings
from jointfit_drivers.can_reception import CanReception
from jointfit_drivers.xcdi._decoder import XcdiDecoder
from jointfit_protocols.can import EXTENDED_MAX, STANDARD_MAX
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.orientation import OrientationGate
from jointfit_protocols.xcdi import QUATERNION_SCALE, DataId, XcdiIds, decode, id_block

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from jointfit_daemon.driver import Emit

_SAMPLE_BYTES = {DataId.SAMPLE_TIME: 4, DataId.GROUP_COUNTER: 2, DataId.QUATERNION: 8}
_ID_NAMES = XcdiIds._fields[:5]


class XcdiIdSettings(Settings):
    """CAN identifiers of one sensor. Every sensor on a bus needs a separate set of identifiers."""

    sample_time: int = Field(DataId.SAMPLE_TIME, ge=0, le=EXTENDED_MAX, description="SampleTime")
    group_counter: int = Field(
        DataId.GROUP_COUNTER, ge=0, le=EXTENDED_MAX, description="GroupCounter"
    )
    quaternion: int = Field(DataId.QUATERNION, ge=0, le=EXTENDED_MAX, description="Quaternion")
    status_word: int | None = Field(
        None,
        ge=0,
        le=EXTENDED_MAX,
        description="StatusWord; default: 0x11, plus the offset of the three identifiers above if "
        "all three have the same offset from their defaults",
    )
    error: int | None = Field(
        None,
        ge=0,
        le=EXTENDED_MAX,
        description="Error; default: 0x01, plus the offset of the three identifiers above if all "
        "three have the same offset from their defaults",
    )

    @override
    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Yield identifiers that are equal, or whose order would split the frames of a sample."""
        in_order: tuple[Any, ...] = (self.sample_time, self.group_counter, self.quaternion)
        ids = self.resolve()._asdict() if None not in in_order else dict(self)

        owners: dict[int, str] = {}
        for name in _ID_NAMES:
            if (number := ids[name]) is None:
                continue
            if (owner := owners.setdefault(number, name)) != name:
                derived = [key for key in (owner, name) if getattr(self, key) is None]
                hint = f" ({derived[0]} is derived from the others: set it, too)" if derived else ""
                yield "", f"each identifier once: found 0x{number:X} for {owner} and {name}{hint}"

        known = [number for number in in_order if number is not None]
        if known != sorted(known):
            keys = ("sample_time", "group_counter", "quaternion")
            found = ", ".join(f"{key} 0x{ids[key]:X}" for key in keys if ids[key] is not None)
            yield (
                "",
                f"found {found}; expected sample_time < group_counter < quaternion: the lowest "
                "identifier is sent first, and the quaternion must be the last frame of a sample. "
                "Set all three as in the device",
            )

    def resolve(self, *, extended: bool = False) -> XcdiIds:
        """Return all identifiers.

        If `status_word` or `error` is omitted, it gets the common offset of the other three
        identifiers from their defaults. Without a common offset, it is None.
        """
        base = self.quaternion - DataId.QUATERNION
        is_block = (
            base >= 0
            and self.sample_time == base + DataId.SAMPLE_TIME
            and self.group_counter == base + DataId.GROUP_COUNTER
        )
        derived = id_block(base) if is_block else XcdiIds(status_word=None, error=None)
        return derived._replace(**self.model_dump(exclude_none=True), extended=extended)


class XcdiSettings(CanImuSettings):
    """One Xsens / Movella IMU on a CAN bus."""

    ids: XcdiIdSettings = Field(
        default_factory=XcdiIdSettings,
        description="identifiers of the sensor; necessary if another sensor on the bus has the "
        "same identifiers",
    )
    extended_ids: bool = Field(
        False,
        description="use 29-bit identifiers even if the numbers fit 11 bits",
    )
    sample_time_unit: Literal["auto", "100us", "1us"] = Field(
        "auto",
        description="unit of SampleTime; auto: determined from ticks per sample and rate_hz",
    )
    byte_order: Literal["big", "little"] = Field("big", description="byte order of the payloads")

    @override
    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Yield 11-bit identifiers that are out of range."""
        ids: Any = self.ids  # None: key cannot be read
        for name, number in ids or ():
            if number is not None and number > STANDARD_MAX and self.extended_ids is False:
                yield (
                    "extended_ids",
                    f"ids.{name} = 0x{number:X} is above 0x{STANDARD_MAX:X}, the greatest 11-bit "
                    "identifier: correct it, or set extended_ids = true if the sensor sends 29-bit "
                    "identifiers",
                )

    @property
    @override
    def can_frames(self) -> tuple[tuple[int, bool], ...]:
        ids = self.ids.resolve(extended=self.extended_ids)
        return tuple(
            (_SAMPLE_BYTES[data_id], extended)
            for (_, extended), data_id in ids.by_id().items()
            if data_id in _SAMPLE_BYTES
        )


class XcdiImu:
    """Xsens IMU on a CAN bus: orientation, device time and counter, in three frames per sample."""

    Settings: ClassVar[type[XcdiSettings]] = XcdiSettings
    wire: ClassVar[Wire] = "can"

    @classmethod
    def candidate_tables(cls, seen: Mapping[tuple[int, bool], int]) -> Iterator[dict[str, Any]]:
        """Yield the identifiers of sensors that may have sent the received frames.

        A candidate consists of a frame of 8 bytes (Quaternion), the frame of 2 bytes with the next
        lower identifier (GroupCounter), and the frame of 4 bytes with the next lower identifier
        (SampleTime). The identifiers of a sensor must be in this order. Each candidate is tried
        with both byte orders. See `jointfit_daemon.device_search`.
        """
        for (quaternion, extended), size in sorted(seen.items()):
            if size != _SAMPLE_BYTES[DataId.QUATERNION]:
                continue
            numbers = {"quaternion": quaternion}
            upper = quaternion
            for name, data_id in (
                ("group_counter", DataId.GROUP_COUNTER),
                ("sample_time", DataId.SAMPLE_TIME),
            ):
                lower = [
                    number
                    for (number, long), count in seen.items()
                    if long == extended and count == _SAMPLE_BYTES[data_id] and number < upper
                ]
                if not lower:
                    break
                upper = numbers[name] = max(lower)
            else:
                ids = {name: numbers[name] for name in sorted(numbers, key=numbers.__getitem__)}
                long_ids = {"extended_ids": True} if extended else {}
                yield {"ids": ids, **long_ids}
                yield {"ids": ids, **long_ids, "byte_order": "little"}

    def __init__(self, settings: XcdiSettings) -> None:
        self._settings = settings
        self._ids = settings.ids.resolve(extended=settings.extended_ids)
        self._reception = CanReception(settings, "with Xsens MT Manager over the sensor's UART")

    def decoder(self) -> XcdiDecoder:
        """Return the decoder from chunks to samples, for live data and replay."""
        settings = self._settings
        return XcdiDecoder(
            self._ids, settings.sample_time_unit, settings.byte_order, settings.rate_hz
        )

    async def run(self, emit: Emit) -> None:
        """Read the bus until cancelled.

        Raises
        ------
        DeviceLostError
            The bus is absent or down, the adapter is unplugged, or the sensor is silent for
            `silence_s`.
        DeviceMisconfiguredError
            This type of bus is not available, or another sensor of the rig uses the same
            identifiers.
        """
        by_id, byte_order = self._ids.by_id(), self._settings.byte_order
        ids = {key: data_id.name.lower() for key, data_id in by_id.items()}
        (needed,) = (key for key, data_id in by_id.items() if data_id is DataId.QUATERNION)

        def resembles(data: bytes) -> bool:
            """Return whether `data` may be a quaternion: four integers with the norm 1."""
            counts = decode(DataId.QUATERNION, data, byte_order)
            if isinstance(counts, CorruptBytes):
                return False
            w, x, y, z = (count * QUATERNION_SCALE for count in counts)
            return OrientationGate().admit((w, x, y, z)) is not None

        await self._reception.run(emit, ids, needed, resembles)
