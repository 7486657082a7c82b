"""Stage 8, bench: run time against error, on built-in scenes whose truth is known."""
