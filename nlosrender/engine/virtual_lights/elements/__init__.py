"""Elements of the hidden surfaces: subdivision by size, clusters, and the patches made of them."""
