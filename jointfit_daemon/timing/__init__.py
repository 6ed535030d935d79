"""When things happened: device clocks to host time, streams to frames, IMU to optical lag."""
