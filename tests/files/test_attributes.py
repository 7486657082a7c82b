"""Attributes are text and finite numbers, whatever they are made from."""

from __future__ import annotations

import json
from datetime import datetime, timedelta, timezone
from fractions import Fraction
from pathlib import Path

import h5py
import numpy as np
import pytest

from nlosrender.capture.bounces import BounceAxis
from nlosrender.files.attributes import get_attributes, set_attributes
from nlosrender.files.capture_results import SummedCapture
from nlosrender.files.provenance import package_versions, provenance_attributes
from nlosrender.files.sums import Sums

VALUES = [
    (True, 1),
    (np.bool_(False), 0),
    (None, "none"),
    (3, 3),
    (2**70, str(2**70)),
    (0.25, 0.25),
    (np.float32("inf"), "inf"),
    ("a\0b", "a\\0b"),
    ("caf\udce9", "caf\\udce9"),
    ("", ""),
    ([1, 2, 3], [1, 2, 3]),
    ((0.5, float("nan")), '[0.5, "nan"]'),
    ([], "[]"),
    (["a", "b"], '["a", "b"]'),
    ([[1], [2, 3]], "[[1], [2, 3]]"),
    ({"x": {1: np.float64(2.5)}, "y": Path("/a")}, '{"x": {"1": 2.5}, "y": "/a"}'),
    (np.arange(20_000), json.dumps(list(range(20_000)))),
    (Path("/a/b"), "/a/b"),
]


@pytest.mark.parametrize(("value", "stored"), VALUES)
def test_round_trip(tmp_path: Path, value: object, stored: object) -> None:
    """Every value has a form that HDF5 takes, that is no enumeration, and that holds no infinity."""
    with h5py.File(tmp_path / "a.hdf5", "w", libver="earliest") as file:
        set_attributes(file, {"name": value})
        set_attributes(file, {"name": value})  # again: it is replaced
        assert file.attrs.get_id("name").get_type().get_class() in (h5py.h5t.STRING, h5py.h5t.INTEGER, h5py.h5t.FLOAT)
    with h5py.File(tmp_path / "a.hdf5") as file:
        assert get_attributes(file) == {"name": stored}


def test_a_number_that_is_not_known_stays_a_number(tmp_path: Path) -> None:
    """A single NaN is what readers of numbers expect of an unknown one."""
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        set_attributes(file, {"name": float("nan")})
        assert file.attrs.get_id("name").get_type().get_class() == h5py.h5t.FLOAT
        assert np.isnan(file.attrs["name"])


def test_foreign_attributes_do_not_stop_anything(tmp_path: Path) -> None:
    """References, empty attributes and bytes that are not UTF-8 are read as text or left out."""
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file.attrs["reference"] = file.ref
        file.attrs["empty"] = h5py.Empty("f4")
        file.attrs["latin"] = np.bytes_(b"caf\xe9")
        file.attrs["flag"] = np.bool_(True)
        file.attrs["pair"] = np.array([(1, 2.0)], dtype=[("a", "i4"), ("b", "f4")])
        found = get_attributes(file)
    assert found["latin"] == "caf\\xe9"
    assert found["flag"] is True
    assert found["pair"] == [[1, 2.0]]
    json.dumps(found)


def test_provenance() -> None:
    """The configuration comes back from its JSON; times are UTC; only what is known is there."""
    created = datetime(2030, 5, 4, 1, 30, tzinfo=timezone(timedelta(hours=2)))
    attributes = provenance_attributes({"name": "é", "n": [1, 2]}, "abc", engine="path", seed=7, created=created)
    assert json.loads(str(attributes["config"])) == {"name": "é", "n": [1, 2]}
    assert attributes["created"] == "2030-05-03T23:30:00+00:00"
    assert (attributes["config_hash"], attributes["render_engine"], attributes["seed"]) == ("abc", "path", 7)
    assert json.loads(str(attributes["versions"]))["h5py"] == h5py.__version__
    assert provenance_attributes({}, "abc").keys() == {"config", "config_hash", "versions", "created"}


def test_results() -> None:
    """Only what is known is there; errors that are not known are null in JSON."""
    attributes = SummedCapture(Sums(energy=(Fraction(1, 2),)), BounceAxis(2, True)).attributes({"render": 2})
    assert json.loads(str(attributes["seconds"])) == {"render": 2.0}
    assert json.loads(str(attributes["energy"])) == {"2": 0.5}
    assert json.loads(str(attributes["energy_error_per_bounce"])) == {"2": None}
    assert not {"samples", "zero_because", "unsampled_first_bounce"} & attributes.keys()


def test_provenance_refuses_local_times() -> None:
    """A time without its zone means nothing in a file that travels."""
    with pytest.raises(ValueError, match=r"created: got .* without a time zone"):
        provenance_attributes({}, "abc", created=datetime(2030, 5, 4))


def test_versions_of_what_is_missing() -> None:
    """A package that is not installed is said to be so."""
    versions = package_versions(("numpy", "no-such-package"))
    assert versions["no-such-package"] == "not installed"
    assert versions["numpy"] == np.__version__
