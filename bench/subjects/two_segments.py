"""Swinging thigh and shank with four markers each, the smallest chain for a benchmark."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics.chains import (
    ChainModel,
    ChainState,
    Joint,
    Marker,
    Segment,
    apply_step,
    marker_positions,
    rest_state,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

NOISE_M = 0.002


def two_segments() -> ChainModel:
    rng = np.random.default_rng(4)
    return ChainModel(
        (Segment("thigh"), Segment("shank", "thigh", Joint("ball", (0.0, 0.0, -0.4)))),
        tuple(
            Marker(f"{s}{k}", s, tuple(rng.normal((0.0, 0.0, -0.2), 0.07).tolist()))
            for s in ("thigh", "shank")
            for k in range(4)
        ),
        "two segments",
    )


def swing(model: ChainModel, count: int = 300) -> tuple[ChainState, NDArray[np.float64]]:
    """Return a movement at 100 Hz, and its noisy markers."""
    phase = np.linspace(0.0, 6.0, count)
    step = np.zeros((count, model.nq))
    step[:, 0], step[:, 3], step[:, 6] = 0.3 * np.sin(phase), 0.1 * phase, 0.6 * np.cos(phase)
    truth = apply_step(model, rest_state(model, count), step)
    exact = marker_positions(model, truth)
    return truth, exact + np.random.default_rng(0).normal(0.0, NOISE_M, exact.shape)
