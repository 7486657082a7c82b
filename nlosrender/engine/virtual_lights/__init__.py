"""The virtual-light engine: the third bounce without noise, gathered from lit patches of the hidden geometry."""
