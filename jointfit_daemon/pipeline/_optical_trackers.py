"""Optical trackers that a rig configures: chain model, planar movement and marker labels."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from jointfit_daemon.pipeline._label_monitor import LabelMonitor
from jointfit_daemon.pipeline.events import Notice, NoticeKind, NoticeLevel
from jointfit_daemon.pipeline.planar_chain import PlanarTracker

if TYPE_CHECKING:
    from jointfit_daemon.config import Rig
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.pipeline.chain_tracking import ChainTracker
    from jointfit_daemon.pipeline.events import Output


def chain_tracker(
    rig: Rig, calibration: Calibration | None, before: ChainTracker | None
) -> ChainTracker | None:
    """Return a tracker of the chain model; None if rig.toml requests none.

    The tracker uses refined markers if the calibration contains refined markers of this model. The
    tracker `before` is returned if it is equivalent.
    """
    if rig.chain_model is None or rig.mqtt.chain_hz <= 0.0:
        return None
    stored = None if calibration is None else calibration.chain
    refined = None if stored is None else stored.apply(rig.chain_model.chain)
    loaded = rig.chain_model if refined is None else replace(rig.chain_model, chain=refined)
    rate_hz, is_refined = rig.mqtt.chain_hz, refined is not None
    covariance = rig.mqtt.chain_covariance
    if before is not None and before.serves(
        loaded, rate_hz, refined=is_refined, covariance=covariance
    ):
        return before
    from jointfit_daemon.pipeline.chain_tracking import (  # noqa: PLC0415 - it loads scipy
        ChainTracker,
    )

    return ChainTracker(loaded, rate_hz, refined=is_refined, covariance=covariance)


def planar_tracker(rig: Rig, before: PlanarTracker | None) -> PlanarTracker | None:
    """Return a tracker of a planar rig, or `before` if it is equivalent; None for other rigs."""
    if not rig.chain.planar:
        return None
    rates = rig.mqtt.sticks_hz, rig.mqtt.sticks_memory_s
    if before is not None and before.serves(rig.chain, *rates):
        return before
    return PlanarTracker(rig.chain, rig.calibration.markers, *rates)


def label_monitor(
    rig: Rig, calibration: Calibration | None, before: LabelMonitor | None
) -> LabelMonitor | None:
    """Return a monitor of the marker labels, or `before` if it has the same settings.

    The result is None without a calibration, or if a chain model is tracked.
    """
    # The tracker of a chain model has its own monitor.
    if calibration is None or (rig.chain_model is not None and rig.mqtt.chain_hz > 0.0):
        return None
    if before is not None and before.serves(rig.chain, calibration):
        return before
    return LabelMonitor(rig.chain, calibration)


def unused_refinement(rig: Rig, calibration: Calibration | None, t_ns: int) -> list[Output]:
    """Return a notice if the calibration contains markers of another chain model."""
    loaded, chain = rig.chain_model, None if calibration is None else calibration.chain
    if loaded is None or chain is None or chain.apply(loaded.chain) is not None:
        return []
    text = (
        "the calibration contains refined markers of another version of the chain model "
        f"({chain.model!r}), so the markers of the model file are used. Repeat the functional "
        "phase to refine them"
    )
    level = NoticeLevel.WARNING
    return [Notice(t_ns, NoticeKind.CALIBRATION, loaded.chain.name, text, level)]
