"""Rows AL-*: streams to frames: what interpolation costs in accuracy, and waiting in latency."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bench.experiment import Experiment

EXPERIMENTS: tuple[Experiment, ...] = ()
