"""Royo et al. 2022, *Non-line-of-sight transient rendering*, reproduced: its figures and tables, each with a number."""
