"""Images: JPEG and video, decoded within limits."""
