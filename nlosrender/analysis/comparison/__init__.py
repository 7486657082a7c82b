"""Compares two captures or two data sets: what differs, by how much, and where most."""
