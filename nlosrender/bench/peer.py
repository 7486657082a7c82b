"""Other renderers as contenders: a command in an environment of its own that answers requests, one JSON line each.

The protocol is in the docstring of ``tests/peers/render_with_mitransient.py``.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np

from nlosrender.bench.generated_meshes import write_ply
from nlosrender.bench.race import FIRST_SAMPLES, Contender
from nlosrender.bench.references import Reference
from nlosrender.bench.runs import LoadedScene, Run
from nlosrender.engine.backend import llvm
from nlosrender.errors import BackendError
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.surfaces import MeshFile

CALIBRATION_LEVEL = 2
UNBIASED_NAME = "mitransient, BSDF sampling"
# Royo et al. 2022's techniques by their names in mitransient. Hidden geometry sampling is biased under occlusion.
UNBIASED: dict[str, Any] = {"nlos_laser_sampling": True}
FASTEST: dict[str, Any] = {"nlos_laser_sampling": True, "nlos_hidden_geometry_sampling": True}


class Peer:
    """A running peer; a context manager.

    Parameters
    ----------
    command
        Python and script, such as ``.venv-peers-mitransient/bin/python tests/peers/render_with_mitransient.py``. The
        LLVM library that we use, and what has to be loaded before it, are appended.

    Raises
    ------
    BackendError
        The command does not run.
    """

    def __init__(self, command: str):
        library = llvm.choose_library()
        if library is None:
            raise BackendError(f"no usable LLVM library was found. {llvm.ADVICE}")
        path = library.path.resolve()
        runtime = [str(found) for name in llvm.WHEEL_RUNTIME for found in path.parent.glob(f"*/{name}")]
        self.command = command
        self.folder = tempfile.TemporaryDirectory(prefix="nlosrender-bench-")
        try:
            self._running = subprocess.Popen(
                [*shlex.split(command), str(path), *runtime], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
        except OSError as error:
            raise BackendError(f"--peer: {command!r} cannot be run: {error}. 'make bench-peers' sets it up.") from error
        self.title = str(self._answer()["peer"])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._running.terminate()
        self._running.communicate()
        self.folder.cleanup()

    def ask(self, request: dict[str, Any]) -> dict[str, Any]:
        """Send one request and wait for its answer.

        Raises
        ------
        BackendError
            The peer has ended.
        """
        if self._running.stdin is not None and self._running.poll() is None:
            self._running.stdin.write(json.dumps(request) + "\n")
            self._running.stdin.flush()
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        line = self._running.stdout.readline() if self._running.stdout is not None else ""
        if not line:
            code = self._running.wait()
            raise BackendError(f"--peer: {self.command!r} ended with exit code {code}; its own message is above.")
        answer: dict[str, Any] = json.loads(line)
        return answer


@dataclass(frozen=True, eq=False)
class PeerContender:
    """A peer with fixed settings on one scene."""

    name: str
    peer: Peer
    description: dict[str, Any]
    settings: dict[str, Any]
    is_random: bool = True
    agreement: dict[str, Any] = field(default_factory=dict)  # of all runs so far with the reference

    def run(self, level: int, seed: int) -> Run:
        """Render once with ``FIRST_SAMPLES * 4^level`` paths per sensor point.

        Raises
        ------
        BackendError
            The peer has ended.
        """
        output = Path(self.peer.folder.name) / "histogram.npy"
        samples = FIRST_SAMPLES * 4**level
        request = {"scene": self.description, "settings": self.settings, "spp": samples, "seed": seed + 1}
        answer = self.peer.ask({**request, "output": str(output)})
        values = np.load(output)[None]
        return Run(values, answer["seconds"], answer["cpu_seconds"], samples=samples, engine=self.peer.title)


def peer_contenders(peer: Peer, loaded: LoadedScene) -> list[Contender]:
    """Return the peer's unbiased and its fastest setting for a scene; its roulette stays at its default."""
    description = describe_scene(loaded, Path(peer.folder.name))
    fastest = dict(FASTEST)
    if loaded.scene.max_bounces != 3:  # as its documentation asks for beyond the third bounce
        fastest["nlos_hidden_geometry_sampling_includes_relay_wall"] = True
    return [
        PeerContender(UNBIASED_NAME, peer, description, UNBIASED),
        PeerContender("mitransient, hidden geometry sampling", peer, description, fastest),
    ]


def describe_scene(loaded: LoadedScene, folder: Path) -> dict[str, Any]:
    """Return a single or confocal scene as the peer's script reads it, in the wall's frame; meshes go to ``folder``."""
    scene = loaded.scene
    grid, axis = loaded.capture.sensor_grid, loaded.time_axis
    surfaces = []
    for number, surface in enumerate(loaded.built.surfaces):
        if isinstance(surface.shape, MeshFile):
            mesh, to_world = Path(surface.shape.filename), surface.shape.to_local
        elif isinstance(surface.shape, TriangleMesh):
            mesh, to_world = folder / f"{scene.name}_{number}.ply", np.eye(4)
            write_ply(mesh, surface.shape.vertices, surface.shape.faces)
        else:
            raise TypeError(f"{scene.name}: peers render triangle meshes, not {type(surface.shape).__name__}")
        surfaces.append({"mesh": str(mesh), "to_world": to_world.tolist(), "bsdf": surface.bsdf})
    confocal = loaded.capture.scan_type == "confocal"  # every sensor point has a laser point of its own
    return {
        "wall": [loaded.built.wall.width, loaded.built.wall.height],
        "wall_reflectance": scene.sections["scene"]["relay_wall"]["bsdf"]["reflectance"],
        "scan": loaded.capture.scan_type,
        "sensors": [grid.ny, grid.nx],
        "laser_point": [0.0, 0.0] if confocal else loaded.capture.laser_grid.wall_coordinates[0, 0].tolist(),
        "bins": [axis.start_opl, axis.bin_width_opl, axis.n_bins],
        "max_bounces": scene.max_bounces,
        "surfaces": surfaces,
    }


def matched(contender: Contender, run: Run, reference: Reference) -> np.ndarray:
    """Bring a peer's result to our unit with one scale for each laser point: its projector's energy depends on it.

    The scale is sum(R^2) / sum(R T) for the reference R and the mean T of all runs so far: linear in T, so that noise
    averages out. The scale of least error, sum(R T) / sum(T^2), would shrink a noisy result until no error exceeds
    100 %. A fitted scale hides an error of the energy, which is therefore reported by itself.
    """
    if not isinstance(contender, PeerContender):
        return run.values
    axes = (3,) if contender.description["scan"] == "confocal" else (1, 2, 3)
    known = contender.agreement
    if not known and len(axes) == 1:  # few bins behind each scale: start from a longer run
        _note_agreement(known, contender.run(CALIBRATION_LEVEL, seed=98), reference, axes)
    _note_agreement(known, run, reference, axes)
    scale = (reference.values**2).sum(axis=axes, keepdims=True) * known["samples"]
    return np.asarray(run.values * (scale / np.where(known["products"] > 0, known["products"], np.inf)))


def _note_agreement(known: dict[str, Any], run: Run, reference: Reference, axes: tuple[int, ...]) -> None:
    """Add the products of a run with the reference, weighted by its samples."""
    products = (run.values * reference.values).sum(axis=axes, keepdims=True)
    known["products"] = known.get("products", 0.0) + products * run.samples
    known["samples"] = known.get("samples", 0) + run.samples
