"""The rig file: cameras, robots and markers of a lab."""
