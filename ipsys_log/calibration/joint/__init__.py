"""Joint calibration: all cameras of a lab, the floor and the paths of robots in one estimate."""
