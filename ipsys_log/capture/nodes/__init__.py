"""Cameras of other hosts, the nodes, over Zenoh."""
