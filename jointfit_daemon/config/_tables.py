"""Models of the tables of rig.toml, except the tables of drivers.

Invariant: unknown keys are rejected, and the description of every field states its meaning and
unit.
``jointfit schema`` prints the descriptions.
"""

from __future__ import annotations

import ipaddress
import math
from typing import TYPE_CHECKING, Any, Literal, get_args

from pydantic import Field, ValidationInfo, field_validator
from typing_extensions import override  # typing contains it from Python 3.12

from jointfit_daemon.calibration import (
    METHODS_OF_OPTION,
    CenterMethod,
    RefinementCost,
    RefinementMethod,
)
from jointfit_daemon.driver import Settings, host_fault
from jointfit_daemon.limb_model import Method, Procedure  # noqa: TC001 - pydantic reads them
from jointfit_daemon.model import AngleConvention  # noqa: TC001 - as above

if TYPE_CHECKING:
    from collections.abc import Iterator

JOINTS_HELP = "joints from proximal to distal, one more than segments"
"""Description of the key ``chain.joints``. The key is required unless the limb has branches."""
_PLAIN, _TLS = 1883, 8883
"""Default ports without and with TLS (IANA: mqtt, secure-mqtt)."""
_LAST_PORT = 65535
"""Largest TCP port."""


class RigTable(Settings):
    """``[rig]``."""

    name: str = Field(description="name of the rig; becomes an MQTT topic")
    output_rate_hz: float = Field(100.0, gt=0, le=1000, description="limb states per second, Hz")
    align_mode: Literal["smooth", "fast"] = Field(
        "smooth",
        description="`smooth` waits for samples before and after an instant and interpolates; "
        "`fast` publishes one sample period earlier and extrapolates by at most one period",
    )


class JointTable(Settings):
    """``[[chain.joint]]``: one joint of a branched limb."""

    name: str = Field(description="name of the joint")
    parent: str = Field(description="segment proximal of the joint")
    child: str | None = Field(
        None,
        description="segment distal of the joint; at the end of a branch a body part with markers "
        "only (foot), or none",
    )
    side: Literal["right", "left"] | None = Field(
        None, description="side of the body; default: the side of the joint above it"
    )


class ChainTable(Settings):
    """``[chain]``: the limb, from proximal to distal."""

    joints: tuple[str, ...] = Field((), min_length=2, description=JOINTS_HELP)
    segments: tuple[str, ...] = Field(min_length=1, description="segments between the joints")
    joint: tuple[JointTable, ...] = Field(
        (),
        min_length=1,
        description="instead of `joints`: the joints of a limb whose first segment carries a right "
        "and a left branch",
    )
    side: Literal["right", "left"] = Field(
        "right", description="side of the body; it determines the signs of the angles"
    )
    proximal: str | None = Field(
        None, description="body part proximal of the first joint, with markers only (pelvis)"
    )
    distal: str | None = Field(
        None, description="body part distal of the last joint, with markers only (foot)"
    )
    axes: Literal["anatomical", "static"] = Field(
        "anatomical",
        description="axes of the segments: `anatomical` from joint centers and the flexion axis; "
        "`static` equal to the optical world in the static pose, with the subject facing +y",
    )
    origin_m: tuple[float, float, float] | None = Field(
        None, description="fixed position of the first joint in the world, m"
    )
    lengths_m: dict[str, float] = Field(
        default_factory=dict,
        description="known segment lengths, m; calibration estimates the others",
    )
    angles: dict[str, AngleConvention] = Field(
        default_factory=dict,
        description="angle conventions of joints; default by the name of the joint: `elevation` "
        "for shoulders, `trunk` for spine and neck, `flexion` for all others",
    )
    motion: Literal["spatial", "planar"] = Field(
        "spatial",
        description="`planar`: cameras alone follow a movement in a plane, with one marker or more "
        "on end segments and two or more on the others; no [[imu]] and no calibration",
    )
    model: str | dict[str, Any] | None = Field(
        None,
        description="chain model for inverse kinematics from the markers: an OpenSim model or a "
        "TOML or JSON file, relative to the folder of rig.toml, or a table with the same keys",
    )

    @field_validator("model", mode="before")
    @classmethod
    def _check_model(cls, model: object) -> object:
        if model is None or isinstance(model, str | dict):
            return model
        raise ValueError("expected the name of a file")


class ChainRefinementTable(Settings):
    """``[calibration.chain_refinement]``: the same options as those of ``jointfit markers``."""

    method: RefinementMethod = Field(
        "joint", description="`joint`: markers and poses together, `block`: in turn, or `search`"
    )
    prior: float = Field(
        0.05,
        ge=0,
        le=100,
        description="cost of a displacement relative to a tracking error; not with method `search`",
    )
    cost: RefinementCost = Field(
        "l2", description="`l2`: squared errors up to 20 mm; `l1`: distances (not for `search`)"
    )
    weights: str | dict[str, float] = Field(
        default_factory=dict,
        description="weights of squared errors by marker, or a .toml or .xml file with them, "
        "relative to the folder of rig.toml",
    )
    lock: tuple[str, ...] = Field(
        (), description='locked markers ("C1") and coordinates in segment axes ("C1.x")'
    )
    unlock: tuple[str, ...] = Field(
        (), description='markers whose locks in the model are ignored; "*" for all'
    )
    holdout: float = Field(
        0.0,
        ge=0,
        le=0.5,
        description="share of the training part, at its end, that decides when the iteration "
        "stops; not with method `search`",
    )
    frames: int = Field(
        150, ge=10, le=1000, description="most frames to fit, and most to evaluate; evenly spaced"
    )
    first_step_mm: float = Field(8.0, ge=0.01, le=100, description="first step of `search`, mm")
    threshold_mm: float = Field(
        2.0, ge=0.001, le=100, description="step at which `search` ends, mm"
    )
    limit_s: float = Field(60.0, gt=0, le=200, description="longest duration of the iteration, s")

    @override
    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Yield options that exclude each other."""
        for key in sorted(self.model_fields_set):
            methods = METHODS_OF_OPTION.get(key.removesuffix("_mm"), get_args(RefinementMethod))
            # A method that is not in the list of methods is a fault of the key `method`.
            if self.method in get_args(RefinementMethod) and self.method not in methods:
                yield (
                    key,
                    (
                        f"method {self.method} does not use this key: remove it, or use method "
                        f"{' or '.join(methods)}"
                    ),
                )
        first_mm: float | None = self.first_step_mm  # None: key cannot be read
        last_mm: float | None = self.threshold_mm
        exceeds = first_mm is not None and last_mm is not None and last_mm > first_mm
        if exceeds and self.method == "search":
            yield "threshold_mm", f"expected first_step_mm = {first_mm:g} or less"
        if self.cost == "l1" and self.method == "search":
            yield "cost", "method search has no loss function: use joint or block, or l2"

    @field_validator("weights", mode="before")
    @classmethod
    def _check_weights(cls, weights: object) -> object:
        if isinstance(weights, str):
            return weights
        if not isinstance(weights, dict):
            raise ValueError("expected a table, or the name of a file")  # noqa: TRY004 - pydantic
        for name, weight in weights.items():
            number = isinstance(weight, int | float) and not isinstance(weight, bool)
            if not number or not 0.0 <= weight < math.inf:
                raise ValueError(f"weight of {name}: expected a number of 0 or more")
        return weights


DEFAULT_STORE = "default"
"""Calibration store of a rig whose configuration names no store."""


class CalibrationTable(Settings):
    """``[calibration]``."""

    store: str = Field(
        DEFAULT_STORE, description="name of the calibration folder below $STATE_DIRECTORY"
    )
    method: Method = Field("anchored", description="method that combines redundant sensors")
    procedure: Procedure = Field(
        "corrected",
        description="`patent`: the steps of the patent alone, with a method patent12 or patent6 "
        'and `axes = "static"`; sensors are not corrected, and a segment with a missing sensor is '
        "lost",
    )
    static_s: float = Field(5.0, gt=0, le=120, description="duration of the static pose, s")
    align_s: float = Field(30.0, gt=0, le=600, description="duration of the align phase, s")
    functional_s: float = Field(
        60.0, gt=0, le=600, description="longest duration of the functional phase, s"
    )
    functional_min_s: float = Field(
        45.0,
        ge=0,
        le=600,
        description="shortest duration of the functional phase, s; it then ends when every "
        "joint center reaches center_target_mm and every joint was flexed far and often enough",
    )
    center_target_mm: float = Field(
        3.0,
        gt=0,
        le=100,
        description="random error of the joint centers, mm, at which the movement suffices; the "
        "error caused by soft-tissue artefact is reported separately",
    )
    center_method: CenterMethod = Field(
        "sphere",
        description="estimator of the joint centers; all but `sphere` and `score` need a movement "
        "about one axis, and refuse other movements",
    )
    joint_center_methods: dict[str, CenterMethod] = Field(
        default_factory=dict,
        description='estimator of single joints, instead of center_method: { knee = "sara" }',
    )
    holdout_share: float = Field(
        0.4,
        gt=0,
        lt=1,
        description="share of the functional phase, at its end, held out to evaluate the fit",
    )
    refine_markers: bool = Field(
        True,
        description="whether the functional phase refines the positions of markers on body parts, "
        "and of the markers of the chain model",
    )
    chain_refinement: ChainRefinementTable = Field(
        default_factory=ChainRefinementTable,
        description="refinement of the markers of [chain] model in the functional phase",
    )
    learn_online: bool = Field(
        True,
        description="whether the models are updated while the cameras see the limb; an update is "
        "used only if it has a smaller error on the latest movement",
    )


def is_this_host(host: str) -> bool:
    """Return whether `host` is this machine (loopback), by name or address."""
    if host == "localhost" or host.endswith(".localhost"):  # RFC 6761
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class TlsSettings(Settings):
    """``[mqtt.tls]``: PEM files, relative to the folder of rig.toml."""

    ca: str | None = Field(None, description="trusted certificates; default: those of the system")
    cert: str | None = Field(None, description="client certificate, for brokers that require one")
    key: str | None = Field(None, description="private key of `cert`; default: in the same file")

    @field_validator("key")
    @classmethod
    def _check_key(cls, key: str | None, info: ValidationInfo) -> str | None:
        if key is not None and info.data.get("cert", "unreadable") is None:
            raise ValueError("the key has no certificate: set cert, too")
        return key


class HomeAssistantSettings(Settings):
    """``[mqtt.home_assistant]``: if present, the daemon announces itself to Home Assistant."""

    enabled: bool = Field(True, description="`false` removes the rig from Home Assistant")
    prefix: str = Field(
        "homeassistant", min_length=1, description="discovery prefix, as in Home Assistant"
    )

    @field_validator("prefix")
    @classmethod
    def _check_prefix(cls, prefix: str) -> str:
        if "" in prefix.split("/") or {"+", "#"} & set(prefix):
            raise ValueError("expected a topic: levels separated by /, none empty, without + and #")
        return prefix


class SpoolSettings(Settings):
    """``[mqtt.spool]``: if present, events and poses of a broker outage are published later."""

    pose_hz: float = Field(
        1.0, ge=0, le=10, description="poses stored per second of an outage, Hz; 0: none"
    )
    keep_mb: float = Field(
        16.0,
        ge=1,
        le=1000,
        description="size of the stored messages, MB, above which the oldest are deleted",
    )


class MqttSettings(Settings):
    """``[mqtt]``."""

    host: str = Field("127.0.0.1", min_length=1, description="name or address of the broker")
    port: int = Field(0, ge=0, le=65535, description="TCP port; 0: 1883, or 8883 with tls")
    base: str = Field("", description="first levels of every topic; default jointfit/<rig name>")
    username: str | None = Field(None, description="user name for the broker")
    password_file: str | None = Field(
        None,
        description="file with the password; default: the systemd credential "
        "jointfitd.mqtt-password",
    )
    tls: TlsSettings | None = Field(None, description="TLS connection to the broker")
    insecure: bool = Field(
        False,
        validate_default=True,
        description="`true` permits plain MQTT to another machine; any host on the network path "
        "can then read and send all messages",
    )
    request_key_file: str | None = Field(
        None,
        description="file with the key that signs requests; a systemd credential of the same name "
        "takes precedence. Default: no signatures, the broker's ACL decides",
    )
    version: Literal["5", "3.1.1"] = Field(
        "5", description="MQTT version, never changed automatically: old brokers need `3.1.1`"
    )
    pose_ui_hz: float = Field(10.0, gt=0, le=30, description="rate of the topic pose/ui, Hz")
    optical_hz: float = Field(
        25.0, ge=0, le=1000, description="greatest rate of the topic optical/pose, Hz; 0: none"
    )
    chain_hz: float = Field(
        10.0,
        ge=0,
        le=100,
        description="greatest rate of the topic optical/chain, Hz; 0: no inverse kinematics",
    )
    chain_covariance: bool = Field(default=False, description="publish covariance in optical/chain")
    sensors_hz: float = Field(
        0.0, ge=0, le=1000, description="greatest rate of the topic sensors/pose, Hz; 0: none"
    )
    centers_memory_s: float = Field(
        0.0,
        ge=0,
        le=3600,
        description="time constant of the running joint centers of the topic optical/centers, s; "
        "0: none",
    )
    sticks_hz: float = Field(
        25.0,
        gt=0,
        le=100,
        description="greatest rate of the topic optical/sticks of planar rigs, Hz",
    )
    sticks_memory_s: float = Field(
        60.0,
        ge=5,
        le=3600,
        description="time constant of the joint centers of planar rigs, s: older frames lose "
        "weight",
    )
    joint_hz: float = Field(1.0, gt=0, le=1, description="rate of the topics joint/NAME, Hz")
    health_s: float = Field(10.0, gt=0, le=60, description="interval of the topic bridge/health, s")
    home_assistant: HomeAssistantSettings | None = Field(
        None, description="discovery by Home Assistant; default: none"
    )
    spool: SpoolSettings | None = Field(
        None, description="later publication of the messages of a broker outage; default: none"
    )

    @field_validator("host")
    @classmethod
    def _check_host(cls, host: str) -> str:
        if (fault := host_fault(host)) is not None:
            raise ValueError(fault)
        return host

    @field_validator("insecure")
    @classmethod
    def _check_insecure(cls, insecure: bool, info: ValidationInfo) -> bool:
        if not {"host", "tls"} <= info.data.keys():
            return insecure  # these keys are faulty and already reported
        host: str = info.data["host"]
        if not (insecure or info.data["tls"] is not None or is_this_host(host)):
            raise ValueError(
                f"broker {host!r} is on another machine and [mqtt.tls] is missing: add it (with ca "
                "for a broker of your own), or allow plain MQTT with insecure = true"
            )
        return insecure

    @property
    def is_local(self) -> bool:
        """Whether the broker is on this machine."""
        return is_this_host(self.host)

    @property
    def tcp_port(self) -> int:
        """TCP port of the broker."""
        return self.port or (_TLS if self.tls else _PLAIN)


class RecordingSettings(Settings):
    """``[recording]``: if present, the daemon records all its input events and its results."""

    directory: str = Field(
        "recordings", min_length=1, description="folder, relative to $STATE_DIRECTORY"
    )
    autostart: bool = Field(
        True, description="record from the start of the daemon; false: when requested"
    )
    file_mb: float = Field(
        1000.0, ge=1, le=1_000_000, description="size after which the next file begins, MB"
    )
    file_minutes: float = Field(
        60.0, ge=0.1, le=10_000, description="time after which the next file begins, minutes"
    )
    keep_gb: float | None = Field(
        None,
        gt=0,
        description="size of all recordings of the rig, GB, above which the oldest files are "
        "deleted; absent: none is deleted",
    )


class LslSettings(Settings):
    """``[lsl]``: if present, the daemon offers streams of the Lab Streaming Layer."""

    name: str = Field(
        "",
        description="prefix of the names of both streams; default: [rig] name",
    )


class MetricsSettings(Settings):
    """``[metrics]``: if present, the daemon offers metrics for Prometheus."""

    listen: str = Field(
        "127.0.0.1:9464",
        description="address and port of http://HOST:PORT/metrics; every host that reaches it "
        "can read the metrics",
    )

    @field_validator("listen")
    @classmethod
    def _check_listen(cls, listen: str) -> str:
        host, separator, port = listen.rpartition(":")
        host = host.removeprefix("[").removesuffix("]")
        if not separator or not port.isascii() or not port.isdigit() or int(port) > _LAST_PORT:
            raise ValueError("expected HOST:PORT, such as 127.0.0.1:9464")
        if (fault := host_fault(host)) is not None:
            raise ValueError(fault)
        return listen

    @property
    def host(self) -> str:
        """Address or name at which the server listens."""
        return self.listen.rpartition(":")[0].removeprefix("[").removesuffix("]")

    @property
    def port(self) -> int:
        """TCP port at which the server listens; 0 selects any free port."""
        return int(self.listen.rpartition(":")[2])
