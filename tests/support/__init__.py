"""Helpers that several folders of tests share: captures without files, references, comparisons, meshes."""
