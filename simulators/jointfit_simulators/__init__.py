"""Virtual hardware: a limb of known geometry as real bytes on ptys, CAN and sockets."""
