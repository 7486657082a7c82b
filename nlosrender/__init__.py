"""Batch renderer for non-line-of-sight (NLOS) imaging datasets."""

__version__ = "0.1.0"
