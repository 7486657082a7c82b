"""The capture on the device: points, histogram, random state and sequences that every engine launches kernels with."""
