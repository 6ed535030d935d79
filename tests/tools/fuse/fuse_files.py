"""Simulated files for `jointfit fuse`: movements with soft-tissue artefact, and a static pose."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
from typer.testing import CliRunner

from jointfit_daemon.files.mocap import MarkerTrajectories, write_trc
from jointfit_daemon.files.orientations import OrientationTrial, write_orientations_npz
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.tools.__main__ import app

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array

N = 200
RATE_HZ = 50.0
LIMB = ["--segment", "thigh=A,B", "--segment", "shank=C,D", "--joints", "hip,knee,ankle"]
MARKERS = {
    "thigh": np.array([(0.0, 0.1, 0.3), (0.05, -0.05, 0.2), (-0.06, 0.02, 0.1)]),
    "shank": np.array([(0.0, 0.1, -0.1), (0.05, -0.05, -0.2), (-0.06, 0.02, -0.3)]),
}
MARKER_OPTIONS = [
    option
    for segment in MARKERS
    for option in ("--markers", f"{segment}=" + ",".join(f"{segment}{k}" for k in range(3)))
]


def run(*arguments: object) -> Any:
    return CliRunner().invoke(app, ["fuse", *map(str, arguments)], catch_exceptions=False)


def said(result: Any) -> str:
    """Return the text that a refused command printed on stderr, as one line."""
    assert result.exit_code == 2, result.output
    return " ".join(result.stderr.split())


def limb(k: int) -> tuple[Array, Array]:
    """Return the orientations of thigh and shank in movement number `k`, shape (N, 4) each.

    Both segments are upright in the first frame.
    """
    t = np.arange(N) / RATE_HZ
    swing = (0.4 + 0.1 * k) * np.sin((1.0 + 0.3 * k) * t)
    bend = -(0.5 + 0.2 * k) * (1.0 - np.cos((1.4 + 0.2 * k) * t))
    zero = np.zeros(N)
    thigh = rotation.exp(np.stack((swing, 0.05 * np.sin(2 * t), zero), axis=1))
    return thigh, rotation.multiply(thigh, rotation.exp(np.stack((bend, zero, zero), axis=1)))


def movement(k: int = 0, *, tissue: float = 0.1) -> OrientationTrial:
    """Return a trial with soft-tissue artefact that is proportional to the knee rotation."""
    thigh, shank = limb(k)
    rng = np.random.default_rng(k)
    joint = rotation.log(rotation.multiply(rotation.conjugate(thigh), shank))
    sensors = {}
    for number, name in enumerate("ABCD"):
        bone = thigh if name in "AB" else shank
        skin = rotation.exp(tissue * (1 + number) / 4 * joint + 0.005 * rng.normal(size=(N, 3)))
        mount = rotation.exp(np.array((0.3 * number, -0.2, 0.1)))
        sensors[name] = rotation.multiply(rotation.multiply(bone, skin), rotation.conjugate(mount))
    return OrientationTrial(np.arange(N) / RATE_HZ, sensors, {"thigh": thigh, "shank": shank}, {})


def still() -> OrientationTrial:
    moving = movement()
    upright = np.tile(rotation.IDENTITY, (N, 1))
    return OrientationTrial(
        moving.t_s,
        {name: np.tile(q[0], (N, 1)) for name, q in moving.sensors.items()},
        {"thigh": upright, "shank": upright},
        {},
    )


def write_trials(folder: Path) -> Path:
    for k in range(3):
        write_orientations_npz(folder / f"m{k}.npz", movement(k))
    write_orientations_npz(folder / "still.npz", still())
    return folder


def trials(files: Path, count: int = 3) -> list[Path]:
    return [files / f"m{k}.npz" for k in range(count)]


def rows(result: Any) -> dict[tuple[str, str], dict[str, Any]]:
    found = json.loads(result.stdout)["rows"]
    return {(row["trial"], row["method"]): row for row in found}


def as_trc(
    path: Path,
    trial: OrientationTrial,
    rate_hz: float = 100.0,
    *,
    scale: float = 1.0,
    stretch: float = 1.0,
) -> None:
    """Write markers on the bones with the rate `rate_hz`, y up.

    The file contains all positions multiplied by `scale`. The distances between the markers of a
    segment are multiplied by `stretch`.
    """
    t_s = np.arange(0.0, trial.t_s[-1], 1.0 / rate_hz)
    names, positions = [], []
    for segment, places in MARKERS.items():
        at = np.clip(np.searchsorted(trial.t_s, t_s, side="right") - 1, 0, N - 2)
        q = trial.bones[segment]
        share = (t_s - trial.t_s[at]) * RATE_HZ
        q = rotation.interpolate(q[at], q[at + 1], share)
        names += [f"{segment}{k}" for k in range(3)]
        moved = rotation.rotate(q[:, None], stretch * places) + np.array((1.0, 2.0, 1.0))
        positions.append(moved[..., [1, 2, 0]])  # convert z up to y up
    frames = np.arange(1, len(t_s) + 1)
    seen = scale * np.concatenate(positions, axis=1)
    write_trc(path, MarkerTrajectories(tuple(names), t_s, frames, seen, rate_hz))
