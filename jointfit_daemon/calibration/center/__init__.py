"""Centers of rotation: planar and spatial, batch and one frame at a time, with their errors."""
