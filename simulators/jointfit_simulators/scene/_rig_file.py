"""Text of a complete rig.toml for a scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from jointfit_simulators.body import LEG_CHAIN

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_simulators.body import RigChain

_SHORTEST_S = 45.0
"""Default of ``functional_min_s`` in the daemon, s. If the functional phase is shorter, rig.toml
contains the duration of the phase instead."""


@dataclass(frozen=True, slots=True)
class RigOptions:
    """Values of rig.toml that do not follow from the scene."""

    name: str = "demo"
    output_rate_hz: float = 100.0
    mqtt_host: str = "127.0.0.1"  # some machines cannot resolve "localhost"
    mqtt_port: int = 1883
    mqtt_base: str = "jointfit/demo"
    mqtt_version: str = "5"
    sensors_hz: float = 0.0
    method: str = "anchored"
    procedure: str = "corrected"
    axes: str = "anatomical"
    store: str = "demo"
    align_s: float = 30.0
    static_s: float = 5.0
    functional_s: float = 60.0


def rig_toml(
    options: RigOptions,
    *,
    devices: Sequence[str],
    mocap: str,
    clusters: Mapping[str, tuple[str, ...]],
    bones: Sequence[str],
    plate: bool,
    chain: RigChain = LEG_CHAIN,
    chain_model: str | None = None,
    planar: bool = False,
) -> str:
    """Return the text of a rig.toml.

    Parameters
    ----------
    options
        Names, broker and calibration settings.
    devices
        Text of the ``[[imu]]`` and ``[can.*]`` tables.
    mocap
        First lines of the ``[mocap]`` table; empty without an optical system.
    clusters
        Marker names of each body part.
    bones
        Segments whose reference is a rigid body instead of markers.
    plate
        Whether the optical system tracks the plate.
    chain
        Joints and segments of the limb.
    chain_model
        File name of the chain model, if there is one.
    planar
        Whether the rig measures a planar movement with cameras alone.
    """
    head, *keys = _chain_table(options, clusters if mocap else {}, chain, chain_model)
    limb = [head, *(['motion = "planar"'] if planar else []), *keys]
    tables = [
        f'[rig]\nname = "{options.name}"\noutput_rate_hz = {options.output_rate_hz:g}\n',
        "\n".join([*limb, ""]),
        *devices,
    ]

    if mocap:
        lines = ['plate = "Plate"'] if plate else []
        for part, names in clusters.items():
            if part not in {"plate", "other", *bones}:
                lines.append(f"markers.{part} = {_names(names)}")
        lines += [f'rigid_body.{bone} = "{bone.capitalize()}"' for bone in bones]
        tables.append("\n".join([mocap, *lines, ""]))

    tables.append(
        f'[calibration]\nstore = "{options.store}"\nmethod = "{options.method}"\n'
        f'procedure = "{options.procedure}"\n'
        f"align_s = {options.align_s:g}\nstatic_s = {options.static_s:g}\n"
        f"functional_s = {options.functional_s:g}\n"
        f"functional_min_s = {min(options.functional_s, _SHORTEST_S):g}\n"
    )
    tables.append(_mqtt_table(options))
    return "\n".join(tables)


def _chain_table(
    options: RigOptions,
    tracked: Mapping[str, tuple[str, ...]],
    chain: RigChain,
    chain_model: str | None,
) -> list[str]:
    """Return the lines of the ``[chain]`` table; `tracked` contains the parts with markers."""
    limb = ["[chain]"]
    if chain.joints:
        limb.append(f"joints = {_names(chain.joints)}")
    limb.append(f"segments = {_names(chain.segments)}")
    if chain.joints:
        limb.append('side = "right"')
    limb.append(f'axes = "{options.axes}"')
    ends = (("proximal", chain.proximal), ("distal", chain.distal))
    limb += [f'{end} = "{part}"' for end, part in ends if part in tracked]

    lengths = ", ".join(f"{segment} = {length:g}" for segment, length in chain.lengths_m.items())
    limb += [f"lengths_m = {{ {lengths} }}"] if lengths else []
    limb += [] if chain_model is None else [f'model = "{chain_model}"']
    for joint, parent, child, side in chain.connections:
        limb += ["[[chain.joint]]", f'name = "{joint}"', f'parent = "{parent}"']
        limb += [f'child = "{child}"'] if child in {*chain.segments, *tracked} else []
        limb += [] if side is None else [f'side = "{side}"']
    return limb


def _mqtt_table(options: RigOptions) -> str:
    return (
        f'[mqtt]\nhost = "{options.mqtt_host}"\nport = {options.mqtt_port}\n'
        f'base = "{options.mqtt_base}"\nversion = "{options.mqtt_version}"\n'
        f"sensors_hz = {options.sensors_hz:g}\n"
    )


def _names(names: Sequence[str]) -> str:
    """Return a TOML array of strings."""
    listed = ", ".join(f'"{name}"' for name in names)
    return f"[{listed}]"
