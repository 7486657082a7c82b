"""Find an LLVM shared library that Dr.Jit can use, without ever loading one that would end the process.

Dr.Jit compiles its kernels with LLVM, a shared library that it looks for when it is imported. Left alone it takes
whatever the system has. Some versions are refused, and some abort the whole process inside a compilation: LLVM 15 on
machines with AVX-512 ("Cannot select: fminimum"). So the library is chosen here, by the version in its file name,
before Dr.Jit is imported; one of an unproven version first has to render a small scene in a process of its own.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

PROVEN_MAJORS = (19, 23)  # ran the whole test suite; any other version is probed first
OLDEST_MAJOR = 16  # 15 aborts on AVX-512 machines, 14 is refused by Dr.Jit
WHEEL = "karellen-llvm-core"
WHEEL_RUNTIME = ("libunwind.so.1", "libc++abi.so.1", "libc++.so.1")  # in the order they need one another
ENVIRONMENT_VARIABLE = "DRJIT_LIBLLVM_PATH"
PROBE_SECONDS = 60.0  # chosen: the probe renders 5 x 3 points twice, seconds where its LLVM works at all
ADVICE = (
    f"Install one: 'pip install {WHEEL}' into this Python environment (no root needed), or your system's LLVM 19 "
    f"(Debian, Ubuntu: 'apt-get install libllvm19'); or name a library in {ENVIRONMENT_VARIABLE}."
)

# A small render with every engine, in a process of its own: simple kernels do not bring out the aborts.
_PROBE = """
import pathlib, sys
from nlosrender.engine.backend.llvm import load_library
load_library(sys.argv[1])
import drjit
from nlosrender.rendering import stages
from nlosrender.config.load import parse_config
from nlosrender.engine.backend.start import start_backend
for engine in ("virtual_lights", "path"):
    config = parse_config(
        "{scene: {relay_wall: {type: rectangle, width: 2.0, height: 1.6}, hidden_geometry: [{type: rectangle,"
        " width: 0.8, height: 0.6, center: [0.15, -0.1, 0.6], normal: [0.2, -0.1, -1.0]}]},"
        " capture: {scan_type: single, sensor_grid: {nx: 5, ny: 3}},"
        " time_axis: {bin_width_opl: 0.02, n_bins: 160},"
        " render: {max_bounces: 5, target_error: 0.2, engine: " + engine + "}}",
        "probe.yaml", pathlib.Path("."))
    backend = start_backend("llvm")
    built = stages.load_scene(config)
    capture, time_axis = stages.describe_capture(config, built.wall, built)
    plan, renderer = stages.prepare(config, backend, built, capture, time_axis)
    from nlosrender.engine.interface import Budget
    energy = renderer.render(plan.batches[0], Budget(target_error=0.2)).mean.sum()
    print("works" if energy > 0 else "no light")
"""


@dataclass(frozen=True)
class LlvmLibrary:
    """One LLVM shared library found on this machine, and whether it may be used."""

    path: Path
    origin: str  # "DRJIT_LIBLLVM_PATH", "system" or the wheel's name
    major: int | None  # None: the version is not in the file's name
    usable: bool
    verdict: str  # why, in words

    @property
    def is_proven(self) -> bool:
        """Whether this is a version known to work."""
        return self.usable and self.major in PROVEN_MAJORS


def find_libraries() -> list[LlvmLibrary]:
    """Return every LLVM library found, in order of preference: the user's, the system's, the wheel's.

    Nothing is loaded into this process; versions not proven are tried in a process of their own.
    """
    return [_judge(*candidate) for candidate in _candidates()]


def choose_library() -> LlvmLibrary | None:
    """Return the library to use, or None when no usable one was found.

    Proven versions win over merely probed ones; the user's choice is the only candidate when there is one.
    """
    candidates = _candidates()
    # Proven ones first, so that a probe (a process each) runs only when nothing better is there.
    candidates.sort(key=lambda candidate: major_version(candidate[0]) not in PROVEN_MAJORS)
    return next((library for library in (_judge(*candidate) for candidate in candidates) if library.usable), None)


def load_library(path: str | Path) -> None:
    """Make Dr.Jit use the library at ``path``; has to run before Dr.Jit is imported.

    Parameters
    ----------
    path
        An LLVM shared library. The wheel's needs its own C++ runtime, which is loaded first.

    Raises
    ------
    OSError
        The C++ runtime beside the library cannot be loaded.
    """
    library = Path(path).resolve()
    # Loaded locally: in the global scope this runtime would take over Mitsuba's C++ exceptions and crash the first one.
    for name in WHEEL_RUNTIME:
        for runtime in library.parent.glob(f"*/{name}"):
            ctypes.CDLL(str(runtime), mode=ctypes.RTLD_LOCAL)
    os.environ[ENVIRONMENT_VARIABLE] = str(library)


def major_version(path: Path) -> int | None:
    """Return the major version an LLVM library carries in its (real) file name, or None."""
    for name in (path.resolve().name, path.name):
        match = re.search(r"LLVM[-.]?(?:so\.)?(\d+)", name) or re.search(r"\.so\.(\d+)", name)
        if match:
            return int(match.group(1))
    return None


def _candidates() -> list[tuple[Path, str]]:
    """Return every library with its origin: the one the user named alone, else the system's and the wheel's."""
    named = os.environ.get(ENVIRONMENT_VARIABLE)
    if named:
        return [(Path(named), ENVIRONMENT_VARIABLE)]
    wheel = _wheel_library()
    return [(path, "system") for path in _system_libraries()] + ([(wheel, WHEEL)] if wheel else [])


def _judge(path: Path, origin: str) -> LlvmLibrary:
    major = major_version(path)

    def verdict(usable: bool, words: str) -> LlvmLibrary:
        return LlvmLibrary(path, origin, major, usable, words)

    if not path.is_file():
        return verdict(False, "no such file")
    if major is not None and major < OLDEST_MAJOR:
        return verdict(False, f"LLVM {major} is refused by Dr.Jit or aborts it; need {OLDEST_MAJOR} or newer")
    if major in PROVEN_MAJORS:
        return verdict(True, "a version known to work")
    return verdict(*_probe(path))


def _probe(path: Path) -> tuple[bool, str]:
    """Render a small scene with the library in a process of its own: a crash there harms nobody."""
    command = [sys.executable, "-c", _PROBE, str(path)]
    try:
        with tempfile.TemporaryDirectory() as home:
            # Dr.Jit keeps compiled kernels below the home folder: from an empty one, everything is compiled anew
            environment = os.environ | {"HOME": home}
            run = subprocess.run(
                command, capture_output=True, text=True, timeout=PROBE_SECONDS, check=False, env=environment
            )
    except (OSError, subprocess.TimeoutExpired) as error:
        return False, f"a trial render could not be run: {error}"
    if run.returncode == 0 and run.stdout.count("works") == 2:
        return True, "not a version known to work, but a trial render succeeded"
    return False, f"a trial render failed (exit code {run.returncode})"


def _wheel_library() -> Path | None:
    try:
        files = importlib.metadata.files(WHEEL) or []
    except importlib.metadata.PackageNotFoundError:
        files = []
    folders = {Path(str(file.locate())).resolve().parent for file in files if "libLLVM" in file.name}
    folders.add(Path(sys.prefix) / "lib")  # the wheel puts its libraries into the environment's own lib folder
    found = [path for folder in sorted(folders) for path in folder.glob("libLLVM*.so*") if path.is_file()]
    return max(found, key=lambda path: len(path.resolve().name)).resolve() if found else None


def _system_libraries() -> list[Path]:
    """Return system LLVM libraries, newest first, one per real file."""
    patterns = (
        "/usr/lib/*/libLLVM*.so*",
        "/usr/lib64/libLLVM*.so*",
        "/usr/lib/libLLVM*.so*",
        "/usr/lib/llvm-*/lib/libLLVM*.so*",
        "/usr/local/lib/libLLVM*.so*",
        "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
    )
    found = {path.resolve() for pattern in patterns for path in Path("/").glob(pattern.lstrip("/")) if path.is_file()}
    return sorted(found, key=lambda path: major_version(path) or 0, reverse=True)
