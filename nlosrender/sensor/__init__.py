"""Stage 5: from the ideal histogram to what a detector reports."""
