"""A rendered lab with known ground truth: three fisheye cameras above markers on a floor."""
