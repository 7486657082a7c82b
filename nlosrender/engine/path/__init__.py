"""The path engine: unbiased transient path tracing with laser and hidden geometry sampling (Royo et al. 2022)."""
