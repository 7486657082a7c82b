"""The LLVM question: a library that would end the process is never loaded, and there is advice when none is left."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from nlosrender.engine.backend import llvm, start
from nlosrender.engine.backend.start import PROCESS_BYTES, batch_memory, scene_memory
from nlosrender.errors import ConfigError


@pytest.mark.parametrize(
    ("name", "major"),
    [
        ("libLLVM.so.19.1", 19),
        ("libLLVM-15.so.1", 15),
        ("libLLVM-14.0.6.so", 14),
        ("libLLVM.so.23.1", 23),
        ("libLLVM-19.so", 19),
        ("libLLVM.so", None),
    ],
)
def test_the_version_is_read_from_the_file_name(name, major, tmp_path):
    """No library is loaded to learn its version."""
    library = tmp_path / name
    library.write_bytes(b"")
    assert llvm.major_version(library) == major


def test_the_version_of_a_link_is_that_of_its_target(tmp_path):
    """``libLLVM.so`` usually points to a file whose name tells."""
    (tmp_path / "libLLVM.so.19.1").write_bytes(b"")
    link = tmp_path / "libLLVM.so"
    link.symlink_to("libLLVM.so.19.1")
    assert llvm.major_version(link) == 19


@pytest.mark.parametrize(
    ("name", "reason"), [("libLLVM-15.so.1", "LLVM 15"), ("missing/libLLVM-19.so", "no such file")]
)
def test_a_named_library_that_cannot_be_used_is_the_only_candidate(name, reason, tmp_path, monkeypatch):
    """The user's choice is not silently replaced by another library."""
    (tmp_path / "libLLVM-15.so.1").write_bytes(b"")
    monkeypatch.setenv(llvm.ENVIRONMENT_VARIABLE, str(tmp_path / name))
    assert llvm.choose_library() is None
    (candidate,) = llvm.find_libraries()
    assert not candidate.usable
    assert reason in candidate.verdict


def test_a_library_of_unknown_version_is_tried_in_a_process_of_its_own(tmp_path, monkeypatch):
    """A file that is no library at all fails there, not here."""
    broken = tmp_path / "libLLVM-21.so"
    broken.write_bytes(b"not a library")
    monkeypatch.setenv(llvm.ENVIRONMENT_VARIABLE, str(broken))
    (candidate,) = llvm.find_libraries()
    assert not candidate.usable
    assert "trial render failed" in candidate.verdict


@pytest.mark.parametrize("command", [["doctor"], ["render", "configs/smoke.yaml", "-o", "never.hdf5"]])
def test_without_a_usable_library_the_exit_code_is_6_and_there_is_advice(command, tmp_path, monkeypatch):
    """Never a crash: the message says what to install."""
    monkeypatch.setenv(llvm.ENVIRONMENT_VARIABLE, str(tmp_path / "libLLVM-15.so"))
    root = Path(__file__).parents[2]
    command = [part if part != "never.hdf5" else str(tmp_path / part) for part in command]
    run = subprocess.run(
        [sys.executable, "-m", "nlosrender", *command], capture_output=True, text=True, check=False, cwd=root
    )
    assert run.returncode == 6, run.stderr
    assert "pip install karellen-llvm-core" in run.stderr
    assert "Traceback" not in run.stderr
    assert not (tmp_path / "never.hdf5").exists()


def test_a_memory_limit_below_the_program_itself_is_an_error():
    """The limit is for the process, so batches get what the program leaves."""
    with pytest.raises(ConfigError, match="memory_limit"):
        batch_memory(int(PROCESS_BYTES) - 1)
    assert batch_memory(int(PROCESS_BYTES) + 1000) == 1000


def test_the_memory_of_a_gpu_counts_where_one_runs(monkeypatch):
    """The least of both bounds a batch; a driver that does not tell leaves the machine's."""

    class Driver:
        def cuDeviceGet(self, device, index):
            return 0

        def cuDeviceTotalMem_v2(self, size, device):
            size._obj.value = 10**9
            return self.code

    driver = Driver()
    machine = start.physical_memory()
    monkeypatch.setattr(start, "_cuda_driver", lambda: driver)
    found = {}
    for variant, driver.code in (("llvm_ad_mono", 0), ("cuda_ad_mono", 0), ("cuda_ad_rgb", 999)):
        monkeypatch.setitem(sys.modules, "mitsuba", SimpleNamespace(variant=lambda variant=variant: variant))
        found[variant] = start.physical_memory()
    assert machine > 10**9
    assert found == {"llvm_ad_mono": machine, "cuda_ad_mono": 10**9, "cuda_ad_rgb": machine}


def test_a_scene_takes_its_part_of_a_memory_limit():
    """What triangles take is not left for batches, but an eighth is; without a limit batches do not get less."""
    limit = int(PROCESS_BYTES) + 10**9
    assert batch_memory(limit, 500_000) == pytest.approx(10**9 - scene_memory(500_000), abs=1)
    assert batch_memory(limit, 10**9) == 10**9 // 8
    assert batch_memory(None, 10**6) == batch_memory(None)


def test_a_dr_jit_imported_too_early_is_an_error_not_a_crash(monkeypatch):
    """Once imported, Dr.Jit keeps the library it found by itself; an unproven one is not used."""
    monkeypatch.delenv(llvm.ENVIRONMENT_VARIABLE, raising=False)  # renders in this process may have set it
    code = (
        "import drjit\n"
        "drjit.detail.llvm_version = lambda: (15, 0, 6)\n"  # as on a machine whose system library is LLVM 15
        "from nlosrender.engine.backend.start import start_backend\n"
        "start_backend('llvm')\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "BackendError: Dr.Jit was imported before its LLVM could be chosen" in run.stderr
