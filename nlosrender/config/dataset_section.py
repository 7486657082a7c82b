"""``dataset``: what the captures of a sweep become for training: splits, index, packages."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

from nlosrender.config.fields import Checked, Flag, MemoryLimit, Seed, Text, as_finite, memory_bytes
from nlosrender.config.issues import invalid_value, mismatch
from nlosrender.config.section import ONE_OF, Section
from nlosrender.errors import ValidationIssue

SPLITS = ("train", "val", "test")
_SUM_SLACK = 1e-9  # 0.8 + 0.1 + 0.1 is not 1


def _share(value: object) -> float:
    number = as_finite(value)
    if number is None or not 0 <= number <= 1:
        raise invalid_value(value, "a share from 0 to 1")
    return number


Share = Annotated[float, Checked(_share, {"type": "number", "minimum": 0, "maximum": 1})]


class SplitConfig(Section):
    """Which captures train, validate and test: told by a hash, so that further captures move none."""

    by: Annotated[Literal["capture", "file", "folder"], ONE_OF] = "capture"
    """what stays together: capture: each by itself; file: all captures of a drawn file; folder: of the files' folder"""
    train: Share = 0.8
    """share of the captures, files or folders"""
    val: Share = 0.1
    """share of the captures, files or folders"""
    test: Share = 0.1
    """share of the captures, files or folders"""
    seed: Seed = 0
    """another one gives other splits"""

    def rule_sum(self) -> Iterator[ValidationIssue]:
        """The shares are all there is."""
        total = self.train + self.val + self.test
        if abs(total - 1) > _SUM_SLACK:
            yield ValidationIssue((), mismatch(total, "train, val and test to add up to 1"))


class DatasetConfig(Section):
    """What is made of the captures of a sweep; no part of any capture."""

    split: SplitConfig | None = None
    """{by: capture, train: 0.8, val: 0.1, test: 0.1}; null: no splits"""
    label: Text | None = None
    """the swept key that says what a capture shows; null: the folder of its drawn file, or its letters"""
    index: Annotated[Literal["csv", "parquet"], ONE_OF] = "csv"
    """table beside index.json; parquet needs the package pyarrow"""
    format: Annotated[Literal["znlos", "webdataset", "lfe", "nlos3d"], ONE_OF] = "znlos"
    """znlos: the captures alone; else also a package of them in a folder of that name: webdataset: tar shards;
    lfe: learned feature embeddings; nlos3d: that program's"""
    shard_size: MemoryLimit = "1GB"
    """of a tar shard, before it is begun anew"""
    dtype: Annotated[Literal["float32", "float16"], ONE_OF] = "float32"
    """of the samples in webdataset packages; the rounding of float16 is added to the stated error"""
    crop: Flag = False
    """webdataset: leave out the first and last bins, those that are dark in all captures"""

    def rule_package(self) -> Iterator[ValidationIssue]:
        """Z-NLOS files, LFE pictures and .mat files have a type of their own, and time counted from a fixed start."""
        if self.dtype == "float16" and self.format != "webdataset":
            yield ValidationIssue(("dtype",), f"got float16, need float32 in format {self.format}.")
        if self.crop and self.format != "webdataset":
            yield ValidationIssue(("crop",), f"got true, need false in format {self.format}, which has a fixed start.")

    @property
    def shard_bytes(self) -> int:
        """Bytes of a shard."""
        return memory_bytes(self.shard_size) or 10**9


def split_of(split: SplitConfig, name: str) -> str:
    """Return the split that a capture or a file of this name belongs to."""
    key = Path(name).parent.as_posix() if split.by == "folder" else name
    ends = (split.train, split.train + split.val)
    share = _hashed_share(split.seed, key)
    return SPLITS[sum(share >= end for end in ends)]


@functools.lru_cache(65536)
def _hashed_share(seed: int, key: str) -> float:
    digest = hashlib.sha256(f"{seed} {key}".encode()).digest()
    return int.from_bytes(digest[:8], "big") / 2**64
