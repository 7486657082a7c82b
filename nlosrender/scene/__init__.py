"""Stage 2: configuration to geometry."""
