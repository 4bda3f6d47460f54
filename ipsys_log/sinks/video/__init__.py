"""Videos of logs: the pictures of the cameras with their markers, and the robots on the floor."""
