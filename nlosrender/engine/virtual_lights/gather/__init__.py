"""The gather of patches: lighting, the kernel, and the delay distribution of a patch over its bins."""
