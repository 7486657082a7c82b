"""Checks samples against the energies that the render summed up: light that was changed, lost or added later shows."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import h5py
import numpy as np

from nlosrender.files import layout
from nlosrender.files.attributes import json_object

# Energies are sums of float64 samples, which the file holds rounded to float32: by at most half a unit in the last of
# 24 digits, or of the smallest denormal number. Twice that leaves room for the float64 sums themselves.
RELATIVE_TOLERANCE = 2.0**-23
SMALLEST = 2.0**-149


def wrong_energies(
    samples: h5py.Dataset,
    parts: Iterable[tuple[tuple[slice, ...], np.ndarray]],
    attributes: Mapping[str, object],
    data_attributes: Mapping[str, object],
) -> list[str]:
    """Return in which bounces the samples do not add up to the attribute ``energy``.

    Parameters
    ----------
    samples, parts
        Dataset ``data``; all samples in it that take space, once each, with their place.
    attributes, data_attributes
        Of the file and of ``data``; a file that states no energies is not judged.
    """
    stated = json_object(attributes.get("energy"))
    indices = data_attributes.get("bounce_indices")
    if not stated or not isinstance(indices, list):
        return []
    if len(stated) != len(indices):
        return [f"attribute 'energy': {len(stated)} bounces, but bounce_indices of data has {len(indices)}"]
    axis = layout.file_axes(samples.ndim == len(layout.CONFOCAL_AXES)).index("bounce")
    total, magnitude = np.zeros((2, samples.shape[axis]))
    # of Stokes components the intensity, as in the render
    intensity_only = attributes.get("channels") == layout.STOKES
    for part, stored in parts:
        if intensity_only and part[0].start > 0:
            continue
        values = (stored[:1] if intensity_only else stored).astype(np.float64)
        others = tuple(index for index in range(values.ndim) if index != axis)
        total[part[axis]] += values.sum(axis=others)
        magnitude[part[axis]] += np.abs(values).sum(axis=others)
    count = samples.size / samples.shape[axis]
    found = []
    for index, (name, energy) in zip(indices, stated.items(), strict=True):
        known = isinstance(index, int) and 0 <= index < len(total) and isinstance(energy, (int, float))
        if not known or not abs(total[index] - energy) <= RELATIVE_TOLERANCE * magnitude[index] + count * SMALLEST:
            sums = f"{total[index]:.9g}" if known else "nothing"
            found.append(f"data: bounce {name} adds up to {sums}, but the render summed up {energy} (attribute energy)")
    for index in sorted(set(range(len(total))) - set(indices)):
        if magnitude[index] > 0 or math.isnan(magnitude[index]):
            found.append(f"data: holds light at bounce index {index}, where the render left none")
    return found
