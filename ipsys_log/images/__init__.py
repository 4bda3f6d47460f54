"""Image decoding: JPEG, PNG, raw images and video, with limits on the size."""
