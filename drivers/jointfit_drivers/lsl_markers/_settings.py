"""The ``[mocap]`` table of a stream of the Lab Streaming Layer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field, field_validator
from typing_extensions import override

from jointfit_daemon.driver import MocapSettings, host_fault

if TYPE_CHECKING:
    from collections.abc import Iterable


class LslMarkersSettings(MocapSettings):
    """The ``[mocap]`` table for every program that sends markers or rigid bodies to LSL."""

    server: str | None = Field(
        None,
        description="host name of the sending PC, or an address to which its name resolves;"
        " default: any in the network",
    )
    stream: str | None = Field(None, min_length=1, description="name of the stream; default: any")
    stream_type: str | None = Field(
        None, min_length=1, description="type of the stream; default: MoCap in any spelling"
    )
    source_id: str | None = Field(
        None, min_length=1, description="identifier of the source, if names are not unique"
    )
    predicate: str | None = Field(
        None,
        min_length=1,
        description="XPath predicate of the stream, such as starts-with(name,'Lab'), instead of"
        " `stream`, `stream_type` and `source_id`",
    )
    unit: Literal["auto", "m", "cm", "mm"] = Field(
        "auto",
        description="unit of the positions; `auto`: as the channels describe it, otherwise metres",
    )
    names: tuple[str, ...] = Field(
        (),
        description="names of the markers in the order of the channels, x y z each, for streams"
        " that do not describe their channels",
    )
    labels: tuple[str, ...] = Field(
        (),
        description="label of every channel, such as T1_X, Thigh_qw or frame, for streams that do"
        " not describe their channels, or describe them wrongly",
    )
    quaternion_order: Literal["auto", "wxyz", "xyzw"] = Field(
        "auto",
        description="components in the channels OrientationA to OrientationD; `auto`: xyzw in"
        " streams of the manufacturer NaturalPoint, otherwise wxyz",
    )
    time: Literal["lsl", "sender"] = Field(
        "lsl",
        description="clock of the time stamps; `lsl`: the LSL clock of the sending PC; `sender`:"
        " another clock, such as the clock of the cameras",
    )
    silence_s: float = Field(5.0, gt=0, description="time without a sample until reconnection, s")

    @field_validator("server")
    @classmethod
    def _server_with_a_name(cls, server: str | None) -> str | None:
        """Reject text that is neither an address nor a host name."""
        if server is not None and (fault := host_fault(server)) is not None:
            raise ValueError(fault)
        return server

    @field_validator("stream", "stream_type", "source_id")
    @classmethod
    def _quotable(cls, text: str | None) -> str | None:
        """Reject text that XPath cannot quote."""
        if text is not None and "'" in text and '"' in text:
            raise ValueError("contains both kinds of quotation marks: use predicate")
        return text

    @override
    def contradictions(self) -> Iterable[tuple[str, str]]:
        """Yield keys that exclude each other, and names that occur twice."""
        for key in ("stream", "stream_type", "source_id"):
            if self.predicate is not None and getattr(self, key) is not None:
                yield key, "predicate replaces this key: remove one of them"
        if self.names and self.labels:
            yield "names", "labels replaces this key: remove one of them"
        for name in sorted(set(self.names or ())):
            if self.names.count(name) > 1:
                yield "names", f"{name!r} occurs twice: every marker needs a name of its own"

    def query(self) -> str:
        """Return the XPath predicate that selects the stream."""
        if self.predicate is not None:
            return self.predicate
        keys = {"name": self.stream, "type": self.stream_type, "source_id": self.source_id}
        parts = []
        for key, text in keys.items():
            if text is not None:
                mark = '"' if "'" in text else "'"
                parts.append(f"{key}={mark}{text}{mark}")
        if not parts:
            # Qualisys uses the type Mocap. XDF's meta-data and the LSL outlet of this project use
            # MoCap.
            parts = [
                "translate(type,'MOCAP','mocap')='mocap'",
                "not(starts-with(source_id,'jointfit-'))",
            ]
        return " and ".join(parts)
