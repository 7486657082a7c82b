"""Relay walls: wall coordinates, positions, normals and texture coordinates of every type."""
