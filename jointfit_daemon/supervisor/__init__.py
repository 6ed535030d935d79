"""The async shell: start, retry, stop, reload, tell systemd. Law: moves events, decides nothing.

Nothing is imported here: the worker process lives in this package and needs none of the shell.
"""
