"""Replacement for the function that processes a recording. It waits, or ends its process."""

from __future__ import annotations

import os
import time

from jointfit_daemon.tools.batch.recording_task import RecordingResult, RecordingTask

SLOW_S = 0.2


def process_or_die(task: RecordingTask) -> RecordingResult:
    """Wait, or end the process if the name of the recording contains `deadly`."""
    if "deadly" in task.name:
        os._exit(9)
    time.sleep(SLOW_S)
    return RecordingResult(task.name, "done")
