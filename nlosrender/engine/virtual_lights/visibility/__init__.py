"""Visibility masks: from which tiles of the wall nothing can hide a surface point."""
