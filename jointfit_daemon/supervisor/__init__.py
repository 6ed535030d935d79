"""The async shell: start, retry, stop, reload, tell systemd. Law: moves events, decides nothing."""

from jointfit_daemon.supervisor.daemon import run_daemon

__all__ = ["run_daemon"]
