"""Sizes and durations in messages and tables."""

import pytest

from nlosrender.readable import readable_duration, readable_size


@pytest.mark.parametrize(
    ("n_bytes", "text"), [(7, "7 B"), (999, "999 B"), (1_250_000, "1.25 MB"), (999_999_999, "1 GB"), (2**40, "1.1 TB")]
)
def test_sizes_are_readable(n_bytes, text):
    """Three digits and a unit of powers of ten, as disks are sold."""
    assert readable_size(n_bytes) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0123, "0.012 s"),
        (3.25, "3.2 s"),
        (99.4, "99 s"),
        (250.0, "4.2 min"),
        (5999.0, "100 min"),
        (7300.0, "2.0 h"),
        (172_800.0, "2.0 days"),
        (6.4e7, "2.0 years"),
        (5.2e20, "1.6e+13 years"),
    ],
)
def test_durations_have_the_unit_a_person_would_take(seconds: float, text: str) -> None:
    """Two digits and a unit."""
    assert readable_duration(seconds) == text
