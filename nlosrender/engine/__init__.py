"""Stage 4: plan to histogram."""
