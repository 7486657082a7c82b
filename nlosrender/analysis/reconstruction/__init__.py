"""From a capture back to the hidden scene: phasor fields and filtered backprojection, without a renderer.

``files.scan`` reads what is needed of a capture; ``voxel_grid`` says where to look; ``phasor`` (with ``pulse``,
``spectrum`` and ``propagation``) and ``backprojection`` compute; ``reconstruct`` is the way through all of them;
``volume_file``, ``picture``, ``silhouette`` and ``score`` are for the result.
"""
