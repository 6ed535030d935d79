"""Diagnosis of a device on a serial line that does not answer, with a search at other line speeds.

Invariant: a device that answers at another speed continues to run as before, and its configuration
is not changed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NoReturn, Protocol

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from jointfit_drivers.ports.serial_port import SerialPort
    from jointfit_drivers.serial_conversation import SerialConversation

_LISTEN_S = 0.15
"""Duration of the search at each speed, s."""
_RESUME_S = 0.5
"""Longest wait until the device continues to stream, s."""


_LISTEN_FIRST_S = 0.4
"""Duration of the search at each speed for a device that sends without a request, s."""


class SpeedConversation(Protocol):
    """Interface of a conversation with a device whose speed is unknown."""

    @property
    def understood(self) -> int:
        """Number of messages received since the reset."""

    def reset(self) -> None:
        """Discard received bytes."""


async def find_other_speed(
    port: SerialPort,
    conversation: SpeedConversation,
    speeds: Sequence[int],
    baud: int,
    answers: Callable[[], Awaitable[bool]],
) -> int | None:
    """Return the speed at which the device answers or sends messages; None if there is none.

    Parameters
    ----------
    port, conversation
        Open port, and conversation with the device on this port.
    speeds
        Speeds to search, bit/s, in this order.
    baud
        Configured speed, which is not searched again.
    answers
        Function that returns whether the device answers at the current speed of the port. The
        device then continues to stream as before.
    """
    for speed in speeds:
        if speed == baud:
            continue
        try:
            port.set_baud(speed)
        except DeviceMisconfiguredError:  # the port does not support it
            continue
        conversation.reset()
        if await answers() or conversation.understood:
            return speed
    return None


async def explain_silence(
    port: SerialPort,
    conversation: SerialConversation[Any],
    *,
    baud: int,
    speeds: Sequence[int],
    hunt: bool,
    family: str,
    pause: Callable[[float], Awaitable[object]],
    resume: Callable[[float], Awaitable[object]],
) -> NoReturn:
    """Raise the error that explains why a device does not answer.

    Parameters
    ----------
    port, conversation
        Open port, and conversation without an answer.
    baud
        Configured speed, bit/s.
    speeds
        Speeds to search, bit/s.
    hunt
        Whether to search for a silent device. If the device's bytes cannot be decoded, the other
        speeds are always searched.
    family
        Name of the device's protocol, for messages.
    pause, resume
        Functions that request the device to stop and to continue streaming. Their argument is the
        longest wait for the reply, s. They return None if there is no reply.

    Raises
    ------
    DeviceLostError
        The device sends nothing, or it streams but does not answer.
    DeviceMisconfiguredError
        The device answers at another speed, or is of another kind.
    """
    received = conversation.received
    if conversation.understood:
        raise DeviceLostError(
            f"{port.path}: streams but does not answer: check the wire from host to device"
        )

    async def answers() -> bool:
        answered = await pause(_LISTEN_S) is not None
        if answered:  # wait for the reply: closing the port discards unsent bytes
            await resume(_RESUME_S)
        return answered

    searched = speeds if hunt or received else ()
    speed = await find_other_speed(port, conversation, searched, baud, answers)
    if speed is not None:
        raise DeviceMisconfiguredError(
            f"{port.path}: {baud} baud, but no message can be decoded; "
            f"the device answers at {speed}: set baud = {speed}"
        )
    if not received:
        raise DeviceLostError(
            f"{port.path}: silent: check its power, and that TX and RX are not swapped"
        )
    raise DeviceMisconfiguredError(
        f"{port.path}: the device on this port does not use {family}: it sends bytes, none of them "
        f"{family} at any common speed: correct `port` or `driver`, which "
        "`jointfit probe` recognizes"
    )


async def explain_missing_messages(
    port: SerialPort,
    conversation: SerialConversation[Any],
    *,
    baud: int,
    speeds: Sequence[int],
    family: str,
) -> NoReturn:
    """Raise the error for a device that sends without a request, if no message has arrived.

    The function sends nothing. The parameters are those of `explain_silence`.

    Raises
    ------
    DeviceLostError
        No bytes arrive, or the device sends only other messages.
    DeviceMisconfiguredError
        The device sends at another speed, or is of another kind.
    """
    if not conversation.received:
        raise DeviceLostError(
            f"{port.path}: silent: check its power and cable, and that the device sends without "
            "a request"
        )
    if conversation.understood:
        raise DeviceLostError(
            f"{port.path}: the device sends messages of {family}, but no measurement: switch this "
            "output on"
        )

    async def sends() -> bool:
        # Every message is refused as a reply, so that no bytes from other speeds are emitted.
        return await conversation.receive(lambda _: False, _LISTEN_FIRST_S) is not None

    speed = await find_other_speed(port, conversation, speeds, baud, sends)
    if speed is not None:
        raise DeviceMisconfiguredError(
            f"{port.path}: {baud} baud, but no message can be decoded; "
            f"the device sends at {speed}: set baud = {speed}"
        )
    raise DeviceMisconfiguredError(
        f"{port.path}: the device on this port does not use {family}: it sends bytes, none of them "
        f"{family} at any common speed: correct `port` or `driver`, which "
        "`jointfit probe` recognizes"
    )
