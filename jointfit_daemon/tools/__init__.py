"""The `jointfit` commands, one module each."""
