"""Robots in the simulated lab, each controlled by a program that gets only positions from a stream."""
