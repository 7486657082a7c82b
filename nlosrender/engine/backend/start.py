"""Start Mitsuba with the variant a scene needs, on a machine that may lack LLVM or a GPU.

This is the only place that picks a variant. Everything after it is the same code for LLVM and CUDA.
"""

from __future__ import annotations

import ctypes
import os
import sys
from dataclasses import dataclass
from typing import Literal, get_args

from nlosrender.engine.backend import llvm
from nlosrender.errors import BackendError, ConfigError, OptionError
from nlosrender.interruption import uninterrupted

BackendName = Literal["auto", "llvm", "cuda"]


@dataclass(frozen=True)
class Backend:
    """What runs the kernels."""

    name: Literal["llvm", "cuda"]
    variant: str  # Mitsuba variant, e.g. "llvm_ad_mono"
    library: str  # the LLVM library, or "CUDA driver"

    @property
    def lanes(self) -> int:
        """Number of parallel lanes that keeps this backend busy."""
        # 128 lanes keep two cores at full speed, 8 x 8 points with their two replicas eight vector units, and 32 x 32
        # points any machine. Not the cores there are: the same capture is to be the same file on every machine. More
        # replicas than needed cost memory and slow the convergence of low-discrepancy numbers.
        return 2**17 if self.name == "cuda" else 128


def cuda_available() -> bool:
    """Return whether an NVIDIA driver with at least one device is on this machine, without starting Dr.Jit."""
    return _cuda_driver() is not None


def _cuda_driver() -> ctypes.CDLL | None:
    name = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
    try:
        driver, count = ctypes.CDLL(name), ctypes.c_int(0)
        found = driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0 and count.value > 0
    except (OSError, AttributeError):
        return None
    return driver if found else None


def start_backend(wanted: BackendName = "auto", *, colored: bool = False, polarized: bool = False) -> Backend:
    """Choose LLVM or CUDA, and activate the Mitsuba variant; Ctrl-C waits until that is done.

    Parameters
    ----------
    wanted
        ``auto`` takes CUDA where a device is present, otherwise LLVM.
    colored
        Render three channels; otherwise one.
    polarized
        Carry Stokes vectors, in grey.

    Raises
    ------
    OptionError
        ``wanted`` is none of these names.
    BackendError
        There is no GPU although ``cuda`` is wanted, or no LLVM that works, or no current folder. The message says what
        to do.
    KeyboardInterrupt
        Ctrl-C was pressed meanwhile.
    """
    if wanted not in get_args(BackendName):
        raise OptionError(f"wanted: got {wanted!r}, need one of {', '.join(get_args(BackendName))}")
    with uninterrupted():  # an import that Ctrl-C cuts off ends in errors of its own, or a crash
        return _started(wanted, colored, polarized)


def _started(wanted: BackendName, colored: bool, polarized: bool) -> Backend:
    try:
        os.getcwd()
    except OSError as error:  # Mitsuba's import would end the process
        raise BackendError(f"the current folder is gone ({error.strerror}). Change to another one.") from error
    if wanted == "cuda" and not cuda_available():
        raise BackendError(
            "render.backend: cuda: no NVIDIA driver with a device was found. Use backend: llvm, or install the driver."
        )
    name: Literal["llvm", "cuda"] = "cuda" if wanted == "cuda" or (wanted == "auto" and cuda_available()) else "llvm"
    library = "CUDA driver" if name == "cuda" else _load_llvm()
    variant = f"{name}_ad_{'mono_polarized' if polarized else 'rgb' if colored else 'mono'}"
    try:
        import mitsuba

        mitsuba.set_variant(variant)
        mitsuba.set_log_level(mitsuba.LogLevel.Error)  # its warnings go to stdout, into the middle of our JSON
        from nlosrender.scene.loading.exact_blend import register_blend
        from nlosrender.scene.loading.retroreflector import register_retroreflector

        register_retroreflector()
        register_blend()
    except ImportError as error:
        raise BackendError(f"Mitsuba cannot start its variant {variant}: {error}. Try 'nlosrender doctor'.") from error
    return Backend(name, variant, library)


def join_backend() -> tuple[Backend, bool]:
    """Return the backend of the variant that a program has set itself, and whether it renders three channels.

    Raises
    ------
    BackendError
        It has set none, or one that the engines do not run on, or Dr.Jit has an LLVM that may abort.
    """
    mitsuba = sys.modules.get("mitsuba")
    variant = None if mitsuba is None else mitsuba.variant()
    names: dict[str, tuple[BackendName, bool]] = {
        f"{name}_ad_{color}": (name, color == "rgb") for name in ("llvm", "cuda") for color in ("mono", "rgb")
    }
    if variant not in names:
        found = "no variant of Mitsuba is set" if variant is None else f"Mitsuba's variant is {variant}"
        raise BackendError(f"{found}, need one of {', '.join(names)}. nlosrender.start_backend() sets one.")
    name, colored = names[variant]
    return start_backend(name, colored=colored), colored


def limit_threads(count: int) -> None:
    """Let Dr.Jit use so many threads of this process; the backend is started."""
    import drjit

    if drjit.thread_count() != count:
        drjit.set_thread_count(count)


def _load_llvm() -> str:
    if "drjit" in sys.modules:
        return _loaded_library()
    library = llvm.choose_library()
    if library is None:
        found = "; ".join(f"{candidate.path}: {candidate.verdict}" for candidate in llvm.find_libraries())
        raise BackendError(f"no usable LLVM library was found ({found or 'none at all'}). {llvm.ADVICE}")
    llvm.load_library(library.path)
    return str(library.path)


def _loaded_library() -> str:
    """Return the library of a Dr.Jit that was imported earlier: it keeps what it found then."""
    import drjit

    named = os.environ.get(llvm.ENVIRONMENT_VARIABLE)
    major = drjit.detail.llvm_version()[0]
    if named is None and major not in llvm.PROVEN_MAJORS:
        raise BackendError(
            f"Dr.Jit was imported before its LLVM could be chosen and took version {major}, which may abort the "
            "process. Call nlosrender.engine.backend.start.start_backend before anything imports drjit or mitsuba."
        )
    return named or f"LLVM {major}, found by Dr.Jit"


PROCESS_BYTES = 400e6  # Python, Mitsuba, LLVM and a small scene, before any histogram
TRIANGLE_BYTES = 700.0  # at most at one time: read, put into trees, cut, merged and lit


def physical_memory() -> int:
    """Return the memory that a render has [bytes]: the machine's, or the GPU's where one runs and has less.

    8 GiB where the system does not tell.
    """
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 8 << 30
    mitsuba = sys.modules.get("mitsuba")
    runs_cuda = mitsuba is not None and (mitsuba.variant() or "").startswith("cuda")
    driver = _cuda_driver() if runs_cuda else None
    return machine if driver is None else min(machine, gpu_memory(driver) or machine)


def gpu_memory(driver: ctypes.CDLL) -> int:
    """Return the memory of the first GPU [bytes], on which Dr.Jit runs; 0 where the driver does not tell."""
    device, size = ctypes.c_int(0), ctypes.c_size_t(0)
    told = driver.cuDeviceGet(ctypes.byref(device), 0) == 0
    return size.value if told and driver.cuDeviceTotalMem_v2(ctypes.byref(size), device) == 0 else 0


def batch_memory(limit: int | None, n_triangles: int = 0) -> int:
    """Return the bytes one batch may take.

    Parameters
    ----------
    limit
        The user's for the process; None: a quarter of ``physical_memory``, beside what the scene takes.
    n_triangles
        Of the scene. However many, an eighth of what the program leaves is for batches.

    Raises
    ------
    ConfigError
        The limit is below what the program itself needs.
    """
    beside = 0 if limit is None else scene_memory(n_triangles)
    if limit is None:
        limit = physical_memory() // 4
    if limit <= PROCESS_BYTES:
        message = f"got {limit / 1e6:.0f} MB, need more than {PROCESS_BYTES / 1e6:.0f} MB, which the program takes "
        raise ConfigError.at("render.memory_limit", f"{message}before any histogram.")
    left = limit - PROCESS_BYTES
    return int(max(left - beside, left / 8))


def scene_memory(n_triangles: int) -> int:
    """Return the bytes that a scene of so many triangles takes, about."""
    return round(TRIANGLE_BYTES * n_triangles)
