"""Simulated lab with known ground truth: rendered images of three fisheye cameras above floor markers."""
