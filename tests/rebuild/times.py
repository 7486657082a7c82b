"""Seconds of the same renders by two source trees, in turns: a rebuild may make no render slower.

    python tests/rebuild/times.py --before TREE --after TREE [--rounds 5] [CONFIG ...]

Every round renders each configuration with both trees, as processes of their own, in turns. It prints the medians of
the CPU seconds of the process and of the seconds of rendering alone, their ratio, and the spread of the ratio over the
rounds: on a shared machine a ratio within the spread says nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

CONFIGS = ("z-letter", "confocal-nlos", "exhaustive-5d", "mesh-wall")


def render(tree: Path, config: Path, folder: Path) -> tuple[float, float]:
    """Render with a source tree; return CPU seconds of the process, and seconds of rendering."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "nlosrender", "render", str(config), "-o", str(folder / "a.hdf5")]
    environment = os.environ | {"PYTHONPATH": str(tree)}
    done = subprocess.run(
        [*command, "--overwrite", "--json"], check=True, capture_output=True, cwd=folder, env=environment
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return cpu, json.loads(done.stdout)["seconds"]["render"]


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--before", type=Path, required=True)
    parser.add_argument("--after", type=Path, required=True)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("configs", nargs="*", type=Path)
    options = parser.parse_args()
    trees = [options.before.resolve(), options.after.resolve()]
    configs = options.configs or [trees[1] / "configs" / f"{name}.yaml" for name in CONFIGS]
    print(f"{'':24} {'CPU s':>15} {'ratio (spread)':>20} {'render s':>15} {'ratio (spread)':>20}")
    for config in configs:
        seconds: list[list[tuple[float, float]]] = [[], []]
        with tempfile.TemporaryDirectory() as folder:
            for tree in trees:  # compiles
                render(tree, config.resolve(), Path(folder))
            for number in range(options.rounds):
                for which in (number % 2, 1 - number % 2):
                    seconds[which].append(render(trees[which], config.resolve(), Path(folder)))
        columns = [f"{config.stem:24}"]
        for part in range(2):
            ours, theirs = ([pair[part] for pair in tree] for tree in (seconds[1], seconds[0]))
            ratios = sorted(one / other for one, other in zip(ours, theirs, strict=True))
            columns.append(f"{statistics.median(theirs):7.2f} {statistics.median(ours):7.2f}")
            columns.append(f"{statistics.median(ratios):7.2f} ({ratios[0]:.2f}-{ratios[-1]:.2f})".rjust(20))
        print(" ".join(columns), flush=True)


if __name__ == "__main__":
    main()
