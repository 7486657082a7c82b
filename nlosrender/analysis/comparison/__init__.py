"""Two captures, or two datasets, against each other: has anything changed, by how much, and where most?"""
