"""Diagnosis of a serial device that does not answer, with a search at other line speeds.

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
"""Longest wait for an answer at each speed, s."""
_RESUME_S = 0.5
"""Longest wait for the reply to the request to continue streaming, s."""


_LISTEN_FIRST_S = 0.4
"""Longest wait at each speed for a message of a device that sends without a request, s."""


class SpeedConversation(Protocol):
    """Interface of a conversation with a device whose speed is unknown."""

    @property
    def understood(self) -> int:
        """Number of messages received since the last reset."""

    def reset(self) -> None:
        """Discard received bytes, and set `understood` to 0."""


async def find_other_speed(
    port: SerialPort,
    conversation: SpeedConversation,
    speeds: Sequence[int],
    baud: int,
    answers: Callable[[], Awaitable[bool]],
) -> int | None:
    """Return the speed, bit/s, at which the device answers or sends; None if no speed is found.

    Parameters
    ----------
    port, conversation
        Open port, and conversation with the device on this port.
    speeds
        Speeds to search, bit/s, in this order.
    baud
        Configured speed, which is not searched again.
    answers
        Function that returns whether the device answers at the current speed of the port. After
        the call, the device streams as before.
    """
    for speed in speeds:
        if speed == baud:
            continue
        try:
            port.set_baud(speed)
        except DeviceMisconfiguredError:  # the port does not support this speed
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
        Open port, and conversation in which the device did not answer.
    baud
        Configured speed, bit/s.
    speeds
        Speeds to search, bit/s.
    hunt
        Whether to search at other speeds if no byte arrived. If bytes arrived that cannot be
        decoded, the other speeds are always searched.
    family
        Name of the device's protocol, for error messages.
    pause, resume
        Functions that request the device to stop streaming, and to continue. Their argument is the
        longest wait for the reply, s. They return None if no reply arrives.

    Raises
    ------
    DeviceLostError
        The device sends nothing, or it streams but does not answer.
    DeviceMisconfiguredError
        The device answers at another speed, or does not use this protocol.
    """
    received = conversation.received
    if conversation.understood:
        raise DeviceLostError(
            f"{port.path}: the device streams but does not answer: check the wire from host to "
            "device"
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
            f"{port.path}: the device is silent: check its power, and that TX and RX are not "
            "swapped"
        )
    raise DeviceMisconfiguredError(
        f"{port.path}: the device on this port does not use {family}: it sends bytes, but no "
        f"{family} message at any common speed: correct `port` or `driver`; `jointfit probe` "
        "recognizes the device on a port"
    )


async def explain_missing_messages(
    port: SerialPort,
    conversation: SerialConversation[Any],
    *,
    baud: int,
    speeds: Sequence[int],
    family: str,
) -> NoReturn:
    """Raise the error for a device that sends without a request, if no measurement has arrived.

    The function sends nothing. The parameters are described at `explain_silence`.

    Raises
    ------
    DeviceLostError
        No bytes arrive, or the device sends messages without measurements.
    DeviceMisconfiguredError
        The device sends at another speed, or does not use this protocol.
    """
    if not conversation.received:
        raise DeviceLostError(
            f"{port.path}: the device is silent: check its power and cable, and that it sends "
            "without a request"
        )
    if conversation.understood:
        raise DeviceLostError(
            f"{port.path}: the device sends messages of {family}, but no measurements: "
            "switch their output on"
        )

    async def sends() -> bool:
        # No message counts as a reply, so that no bytes from other speeds are emitted.
        return await conversation.receive(lambda _: False, _LISTEN_FIRST_S) is not None

    speed = await find_other_speed(port, conversation, speeds, baud, sends)
    if speed is not None:
        raise DeviceMisconfiguredError(
            f"{port.path}: {baud} baud, but no message can be decoded; "
            f"the device sends at {speed}: set baud = {speed}"
        )
    raise DeviceMisconfiguredError(
        f"{port.path}: the device on this port does not use {family}: it sends bytes, but no "
        f"{family} message at any common speed: correct `port` or `driver`; `jointfit probe` "
        "recognizes the device on a port"
    )
