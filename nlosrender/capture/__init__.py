"""Stage 3: what is measured, and in which order."""
