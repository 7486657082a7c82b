"""Triangle meshes: generated ones, and those of .ply and .obj files."""
