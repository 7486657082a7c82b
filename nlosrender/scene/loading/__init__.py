"""Geometry to Mitsuba: shapes, materials and whole scene files; all that imports Mitsuba but build.py and view.py."""
