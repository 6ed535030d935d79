"""The asynchronous shell of the daemon: sources, core, outputs, reloads, systemd, worker process.

The shell passes events between components, and makes no decisions about measurements. This package
exports no names. Its public modules are the entry points `daemon`, `worker`, `process_exit` and
`state_directory`. A worker process imports only the module `worker`.
"""
