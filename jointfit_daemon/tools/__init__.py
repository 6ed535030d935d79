"""Commands of the `jointfit` command line, one module or package each."""
