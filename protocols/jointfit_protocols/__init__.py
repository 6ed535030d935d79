"""Wire formats without I/O: codecs for drivers and simulators, one package per family."""
