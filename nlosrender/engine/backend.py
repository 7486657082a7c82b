"""Start Mitsuba with the variant a scene needs, on a machine that may lack LLVM or a GPU.

This is the only place that picks a variant. Everything after it is the same code for LLVM and CUDA.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from typing import Literal

from nlosrender.engine import llvm
from nlosrender.errors import BackendError

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
        return 2**18 if self.name == "cuda" else 2**12


def cuda_available() -> bool:
    """Return whether an NVIDIA driver with at least one device is on this machine, without starting Dr.Jit."""
    import ctypes

    name = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
    try:
        driver = ctypes.CDLL(name)
        count = ctypes.c_int(0)
        return driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0 and count.value > 0
    except (OSError, AttributeError):
        return False


def start_backend(wanted: BackendName = "auto", *, colored: bool = False) -> Backend:
    """Choose LLVM or CUDA, and activate the Mitsuba variant.

    Parameters
    ----------
    wanted
        ``auto`` takes CUDA where a device is present, otherwise LLVM.
    colored
        Render three channels; otherwise one.

    Raises
    ------
    BackendError
        There is no GPU although ``cuda`` is wanted, or no LLVM that works. The message says what to install.
    """
    if wanted == "cuda" and not cuda_available():
        raise BackendError("render.backend: cuda: no NVIDIA driver with a device was found. Use backend: llvm, or install the driver.")
    name: Literal["llvm", "cuda"] = "cuda" if wanted == "cuda" or (wanted == "auto" and cuda_available()) else "llvm"
    library = "CUDA driver" if name == "cuda" else _load_llvm()
    variant = f"{name}_ad_{'rgb' if colored else 'mono'}"
    try:
        import mitsuba

        mitsuba.set_variant(variant)
    except ImportError as error:
        raise BackendError(f"Mitsuba cannot start its variant {variant}: {error}. Try 'nlosrender doctor'.") from error
    return Backend(name, variant, library)


def _load_llvm() -> str:
    if "drjit" in sys.modules:  # loaded already: Dr.Jit keeps the library it has
        return os.environ.get(llvm.ENVIRONMENT_VARIABLE, "chosen by Dr.Jit")
    library = llvm.choose_library()
    if library is None:
        found = "; ".join(f"{candidate.path}: {candidate.verdict}" for candidate in llvm.find_libraries())
        raise BackendError(f"no usable LLVM library was found ({found or 'none at all'}). {llvm.ADVICE}")
    llvm.load_library(library.path)
    return str(library.path)
