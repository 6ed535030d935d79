"""The asynchronous shell of the daemon: sources, core, outputs, reloads, systemd, worker process.

The shell moves events and makes no decisions about measurements. This package exports nothing: its
public modules are the entry points `daemon`, `worker`, `process_exit` and `state_directory`, and a
worker process imports only the module `worker`.
"""
