"""The activity bar is shown on a terminal, is absent from pipes, and passes errors on."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys

import pytest

from jointfit_daemon.tools.activity import show_activity

PROGRAM = """
import time
from jointfit_daemon.tools.activity import show_activity
with show_activity("fitting") as print_line:
    time.sleep(0.3)
    print_line("[1/2] a line")
"""


def test_a_terminal_shows_the_label_and_the_elapsed_time() -> None:
    parent, child = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "80"}
    command = [sys.executable, "-c", PROGRAM]
    with subprocess.Popen(command, stderr=child, env=environment) as process:
        os.close(child)
        shown = b""
        while True:
            try:
                shown += os.read(parent, 4096)
            except OSError:  # the program has ended
                break
    os.close(parent)
    assert process.returncode == 0
    assert b"fitting" in shown
    assert b"0:00:00" in shown
    # The bar is erased before the line is printed.
    assert re.search(rb"\r\x1b\[2K\[1/2\] a line\r\n", shown)


def test_a_pipe_receives_the_lines_only() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, check=True)
    assert done.stdout == b""
    assert done.stderr == b"[1/2] a line\n"


def test_errors_pass_through() -> None:
    with pytest.raises(ValueError, match="broken"), show_activity("fitting"):
        raise ValueError("broken")
