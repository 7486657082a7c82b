"""Record the bytes of many small captures rendered by a source tree, and compare two records.

    python tests/rebuild/bit_identity.py record --source TREE -o FOLDER [--only PATTERN] [--jobs N]
    python tests/rebuild/bit_identity.py compare BEFORE AFTER [--only PATTERN]
    python tests/rebuild/bit_identity.py list

``record`` runs ``python -m nlosrender`` of TREE as a subprocess per capture, and leaves the HDF5 files and
``record.json`` in FOLDER; it adds to a record that is there. ``compare`` exits 1 when a dataset differs or a capture
is missing. Attributes that differ are listed, and count with ``--attributes`` alone.
"""

from __future__ import annotations

import argparse
import contextlib
import fnmatch
import hashlib
import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml
from rebuild_captures import CaptureCase, capture_cases, write_files

RECORD = "record.json"
# what a capture states of itself and no rebuild changes; seconds, versions and dates do change
ATTRIBUTES = (
    *("capture_hash", "render_engine", "samples", "replicas", "unsampled_paths", "max_bounces", "energy"),
    *("energy_error", "energy_error_per_bounce", "error_estimate", "error_estimate_per_bounce", "out_of_window_energy"),
)
MAX_SECONDS = 240.0  # of one command: 50 times the slowest capture on an idle core
KILL_AFTER = (5, 8, 3, 12, 6, 9, 4)  # changes of the unfinished render's size, tried in turn: some work items are saved


class RecordError(Exception):
    """A capture cannot be recorded; says which, and what the command printed."""


def fingerprint(path: Path) -> dict[str, Any]:
    """Return digests, shapes, dtypes and sums of all datasets of a capture, and the attributes it is held to."""
    with h5py.File(path) as file:
        datasets = {}
        for name in sorted(file):
            values = np.asarray(file[name][()])
            datasets[name] = {
                "sha256": hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest(),
                "shape": list(values.shape),
                "dtype": str(values.dtype),
                "sum": float(values.sum(dtype=np.float64)),
            }
        attributes = {name: _plain(file.attrs[name]) for name in ATTRIBUTES if name in file.attrs}
    return {"datasets": datasets, "attributes": attributes}


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


# --- record ----------------------------------------------------------------------------------------------------------


class Recorder:
    """Renders captures with the command line of a source tree.

    Parameters
    ----------
    source
        The tree whose ``nlosrender`` is run.
    folder
        Where captures and the record go.
    """

    def __init__(self, source: Path, folder: Path):
        self.source, self.folder = source.resolve(), folder.resolve()
        if not (self.source / "nlosrender" / "__main__.py").is_file():
            raise RecordError(f"{source}: no source tree, nlosrender/__main__.py is missing")
        self.environment = os.environ | {"PYTHONPATH": str(self.source), "PYTHONDONTWRITEBYTECODE": "1"}
        self.folder.mkdir(parents=True, exist_ok=True)
        found = self._python("-c", "import nlosrender; print(nlosrender.__file__)").stdout.strip()
        if Path(found).resolve().parent != self.source / "nlosrender":
            raise RecordError(f"{source}: Python imports {found} instead")
        self.inputs = self.folder / "inputs"
        write_files(self.inputs)

    def record(self, case: CaptureCase) -> dict[str, Any]:
        """Render a capture; return its entry of the record."""
        begun = time.perf_counter()
        target = self.folder / f"{case.name}.hdf5"
        config = self.inputs / f"{case.name}.yaml"
        text = yaml.safe_dump(dict(case.config), sort_keys=False)
        config.write_text(text)
        report = getattr(self, f"_{case.mode}")(config, target)
        entry = fingerprint(target)
        engine = entry["attributes"].get("render_engine")
        if engine != case.engine:
            raise RecordError(f"{case.name}: rendered by {engine}, need {case.engine}: {report.get('reason')}")
        if (entry["datasets"]["data"]["sum"] == 0) != case.is_zero:
            raise RecordError(f"{case.name}: the sum of data is {entry['datasets']['data']['sum']}")
        keys = ("units", "resumed_units", "n_triangles")
        entry |= {"config": hashlib.sha256(text.encode()).hexdigest(), "mode": case.mode, "same_as": case.same_as}
        entry |= {"report": {k: report[k] for k in keys if k in report}}
        return entry | {"seconds": round(time.perf_counter() - begun, 2)}

    def _render(self, config: Path, target: Path, *options: str) -> dict[str, Any]:
        done = self._cli("render", str(config), "-o", str(target), "--overwrite", "-q", "--json", *options)
        return json.loads(done.stdout)

    def _shards(self, config: Path, target: Path) -> dict[str, Any]:
        return self._merged(config, target, [("--shard", f"{k}/3") for k in (1, 2, 3)])

    def _lasers(self, config: Path, target: Path) -> dict[str, Any]:
        return self._merged(config, target, [("--lasers", part) for part in ("0:3", "3:8", "8:14")])

    def _merged(self, config: Path, target: Path, selections: Sequence[tuple[str, str]]) -> dict[str, Any]:
        parts = [target.with_suffix(f".part{k}.hdf5") for k in range(len(selections))]
        for part, selection in zip(parts, selections, strict=True):
            report = self._render(config, part, *selection)
        self._cli("merge", *map(str, reversed(parts)), "-o", str(target), "--overwrite", "-q")
        for part in parts:
            part.unlink()
        return {"reason": report.get("reason")}

    def _dask(self, config: Path, target: Path) -> dict[str, Any]:
        return self._render(config, target, "--executor", "dask", "--workers", "2")

    def _kill(self, config: Path, target: Path) -> dict[str, Any]:
        return self._gone_on_with(config, target, signal.SIGKILL)

    def _stop(self, config: Path, target: Path) -> dict[str, Any]:
        # not SIGINT, which the children of a command in the background of a script ignore
        return self._gone_on_with(config, target, signal.SIGTERM)

    def _gone_on_with(self, config: Path, target: Path, number: signal.Signals) -> dict[str, Any]:
        """End a render by a signal when some of it is finished, and go on with the same command."""
        for changes in KILL_AFTER:
            self._interrupted(config, target, number, changes)
            done = self._cli("render", str(config), "-o", str(target), "-q", "--json")
            report = json.loads(done.stdout)
            if report["resumed_units"] > 0:
                return report
        raise RecordError(f"{target.name}: no interruption left some of {report['units']} work items finished")

    def _interrupted(self, config: Path, target: Path, number: signal.Signals, changes: int) -> None:
        """Begin a render, and send a signal when what it has saved has changed its size so often."""
        target.unlink(missing_ok=True)
        command = [sys.executable, "-m", "nlosrender", "render", str(config), "-o", str(target), "--overwrite", "-q"]
        pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        with subprocess.Popen(command, env=self.environment, cwd=self.folder, **pipes) as process:
            limit, size = time.monotonic() + MAX_SECONDS, 0
            while process.poll() is None and changes > 0 and time.monotonic() < limit:
                before, size = size, self._saved_bytes(target)
                changes -= size != before
                time.sleep(0.003)
            process.send_signal(number)
            process.wait(MAX_SECONDS)

    def _saved_bytes(self, target: Path) -> int:
        """Return the size of all files of an unfinished render: those with ``partial`` in their path."""
        unfinished = [path for path in self.folder.iterdir() if "partial" in path.name and target.name in path.name]
        size = 0
        for path in (file for top in unfinished for file in (top, *top.rglob("*"))):
            with contextlib.suppress(OSError):
                size += path.stat().st_size if path.is_file() else 0
        return size

    def _cli(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        return self._python("-m", "nlosrender", *arguments)

    def _python(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, *arguments]
        options = {"capture_output": True, "text": True, "timeout": MAX_SECONDS}
        done = subprocess.run(command, env=self.environment, cwd=self.folder, check=False, **options)
        if done.returncode != 0:
            raise RecordError(f"{' '.join(command[1:])}: exit code {done.returncode}\n{done.stderr.strip()[-1500:]}")
        return done


def record_captures(source: Path, folder: Path, cases: Sequence[CaptureCase], jobs: int = 1) -> list[str]:
    """Render captures of a tree into a folder and its record; return what failed, in sentences."""
    recorder, failures = Recorder(source, folder), []
    path = folder / RECORD
    captures = read_record(folder)["captures"] if path.exists() else {}

    def attempt(case: CaptureCase) -> dict[str, Any] | str:
        try:
            return recorder.record(case)
        except (RecordError, subprocess.TimeoutExpired, OSError, KeyError, ValueError) as error:
            return f"{case.name}: {error}"

    with ThreadPoolExecutor(jobs) as pool:
        for case, result in zip(cases, pool.map(attempt, cases), strict=True):
            if isinstance(result, str):
                failures.append(result)
                captures.pop(case.name, None)
                print(f"FAILED {result}", file=sys.stderr, flush=True)
                continue
            captures[case.name] = result
            print(f"{case.name:36} {result['seconds']:6.1f} s", file=sys.stderr, flush=True)
            text = json.dumps({"source": str(recorder.source), "captures": captures}, indent=1, sort_keys=True)
            path.write_text(text + "\n")
    return failures


# --- compare ---------------------------------------------------------------------------------------------------------


def read_record(place: Path) -> dict[str, Any]:
    """Return the record in a folder, or in a JSON file, and the folder its captures lie in."""
    path = place / RECORD if place.is_dir() else place
    return json.loads(path.read_text()) | {"folder": path.parent}


def compare_records(
    before: Mapping[str, Any], after: Mapping[str, Any], pattern: str = "*"
) -> Iterator[tuple[str, str, str]]:
    """Yield (capture, verdict, detail); verdicts are same, attributes, DIFFERENT and MISSING."""
    names = dict.fromkeys((*before["captures"], *after["captures"]))
    for name in names:
        if not fnmatch.fnmatchcase(name, pattern):
            continue
        old, new = (record["captures"].get(name) for record in (before, after))
        if old is None or new is None:
            yield name, "MISSING", f"not in {'BEFORE' if old is None else 'AFTER'}"
            continue
        if len({entry["config"] for entry in (old, new) if "config" in entry}) > 1:  # early records have none
            yield name, "DIFFERENT", "another configuration: record both trees with one list"
            continue
        differing = [key for key in dict.fromkeys((*old["datasets"], *new["datasets"])) if _differ(old, new, key)]
        reference = after["captures"].get(old.get("same_as"))
        if differing:
            paths = [Path(record["folder"]) / f"{name}.hdf5" for record in (before, after)]
            yield name, "DIFFERENT", "; ".join(f"{key}: {_difference(paths, key)}" for key in differing)
        elif reference and any(_differ(reference, new, key) for key in ("data", "variance")):
            yield name, "DIFFERENT", f"from {old['same_as']} in AFTER, whose samples it has to have"
        else:
            changed = [
                k for k in ATTRIBUTES if str(old["attributes"].get(k)) != str(new["attributes"].get(k))
            ]  # nan equals nan
            yield name, "attributes" if changed else "same", ", ".join(changed)


def _differ(old: Mapping[str, Any], new: Mapping[str, Any], key: str) -> bool:
    one, other = (entry["datasets"].get(key) for entry in (old, new))
    facts = ("sha256", "shape", "dtype")
    return one is None or other is None or any(one[fact] != other[fact] for fact in facts)


def _difference(paths: Sequence[Path], key: str) -> str:
    """Return how far apart a dataset of two files is, where both are kept."""
    if not all(path.is_file() for path in paths):
        return "differs (no files to measure by)"
    values = []
    for path in paths:
        with h5py.File(path) as file:
            if key not in file:
                return f"not in {path}"
            values.append(np.asarray(file[key][()]))
    one, other = values
    if one.shape != other.shape or one.dtype != other.dtype:
        return f"{one.shape} {one.dtype}, then {other.shape} {other.dtype}"
    one, other = one.astype(np.float64), other.astype(np.float64)
    apart, largest = np.abs(one - other), np.maximum(np.abs(one), np.abs(other))
    relative = (apart / np.where(largest > 0, largest, 1)).max(initial=0)
    norm = float(np.sqrt((apart**2).sum() / max((one**2).sum(), 1e-300)))
    return f"max relative {relative:.2g}, relative L2 {norm:.2g}, {np.count_nonzero(apart)} of {apart.size} values"


# --- command line ----------------------------------------------------------------------------------------------------


def selected_cases(pattern: str) -> list[CaptureCase]:
    """Return the captures whose names match; those by dask only where it is installed."""
    has_dask = importlib.util.find_spec("distributed") is not None
    return [c for c in capture_cases() if fnmatch.fnmatchcase(c.name, pattern) and (has_dask or c.mode != "dask")]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    summary, usage = re.split(r"\n\n", __doc__ or "", maxsplit=1)
    parser = argparse.ArgumentParser(description=summary, epilog=usage)
    commands = parser.add_subparsers(dest="command", required=True)
    record = commands.add_parser("record", help="render the captures of a source tree")
    record.add_argument("--source", type=Path, required=True, metavar="TREE")
    record.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER")
    record.add_argument("--jobs", type=int, default=1, help="captures rendered at a time (default 1)")
    compare = commands.add_parser("compare", help="compare two records")
    compare.add_argument("before", type=Path)
    compare.add_argument("after", type=Path)
    compare.add_argument("--attributes", action="store_true", help="exit 1 as well where stated attributes differ")
    listing = commands.add_parser("list", help="print the names of the captures")
    for command in (record, compare, listing):
        command.add_argument("--only", default="*", metavar="PATTERN", help="names, with * and ?")
    chosen = parser.parse_args(arguments)
    if chosen.command == "list":
        print("\n".join(f"{case.name:36} {case.engine:16} {case.mode}" for case in selected_cases(chosen.only)))
        return 0
    if chosen.command == "record":
        try:
            failures = record_captures(chosen.source, chosen.output, selected_cases(chosen.only), chosen.jobs)
        except RecordError as error:
            failures = [str(error)]
        print("\n".join(failures) if failures else f"recorded in {chosen.output}")
        return 1 if failures else 0
    rows = list(compare_records(read_record(chosen.before), read_record(chosen.after), chosen.only))
    for name, verdict, detail in rows:
        print(f"{name:36} {verdict:10} {detail}".rstrip())
    wrong = {"DIFFERENT", "MISSING"} | ({"attributes"} if chosen.attributes else set())
    n_wrong = sum(verdict in wrong for _, verdict, _ in rows)
    print(f"{len(rows)} captures, {n_wrong} wrong")
    return 1 if n_wrong or not rows else 0


if __name__ == "__main__":
    sys.exit(main())
