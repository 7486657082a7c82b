"""The script behind ``make gpu-check`` finds what differs, and says where there is no GPU."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import compare_backends
import pytest

from nlosrender.engine.backend.start import cuda_available
from nlosrender.errors import EXIT_COMPARISON_EXCEEDED, EXIT_ENVIRONMENT, EXIT_OK

SOME = ("single", "path engine, colours", "mirror, virtual lights")


@pytest.mark.slow
@pytest.mark.parametrize(("energy", "code"), [(1.0, EXIT_OK), (1.1, EXIT_COMPARISON_EXCEEDED)])
def test_a_wrong_energy_of_one_backend_is_found_and_another_seed_is_not(
    energy: float, code: int, tmp_path: Path
) -> None:
    """A tenth more light is beyond the noise of every capture and beyond rounding."""
    backends, changes = ("llvm", "llvm"), [f"capture.laser_energy={energy}"]
    rows = list(compare_backends.compare_backends(backends, tmp_path, SOME, changes))
    assert [(row.name, row.exit_code) for row in rows] == [(name, code) for name in SOME]
    assert all(len(row.seconds) == 2 and row.engine and row.verdict for row in rows)


@pytest.mark.slow
@pytest.mark.skipif(cuda_available(), reason="there is a GPU")
def test_without_a_gpu_the_script_ends_with_the_usual_message(tmp_path: Path) -> None:
    """Exit code 6, before anything is rendered."""
    command = [sys.executable, compare_backends.__file__, "-o", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == EXIT_ENVIRONMENT
    assert "no NVIDIA driver with a device was found" in done.stderr
    assert not list(tmp_path.glob("*.hdf5"))
