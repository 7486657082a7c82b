"""Relay walls: wall coordinates, positions and normals of every type."""
