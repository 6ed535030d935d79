"""Marks: labels that a person or a program requests for an instant of a session."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.pipeline.events import Notice, NoticeKind

if TYPE_CHECKING:
    from jointfit_daemon.pipeline.events import Output, Request


def mark_outputs(
    request: Request, number: int, unix_offset_ns: int | None, rig: str
) -> list[Output]:
    """Return the answer to a request for a mark, and the event that marks the instant.

    Parameters
    ----------
    request
        Request that contains the ``text`` of the mark.
    number
        Number of the mark since the start of the daemon, from 1.
    unix_offset_ns
        UNIX time minus CLOCK_MONOTONIC, ns; None if unknown.
    rig
        Name of the rig.
    """
    t_ns, text = request.t_ns, str(request.arguments.get("text", ""))
    t_us = None if unix_offset_ns is None else (t_ns + unix_offset_ns) // 1000
    return [
        request.reply("ok", {"number": number, "t_us": t_us, "text": text}),
        Notice(t_ns, NoticeKind.MARK, rig, text, data={"number": number}),
    ]
