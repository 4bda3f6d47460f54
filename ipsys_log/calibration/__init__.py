"""Camera intrinsics from images of a calibration board."""
