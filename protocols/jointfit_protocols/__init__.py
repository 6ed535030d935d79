"""Wire formats without I/O: the same codecs serve drivers and simulators, one package a family."""
