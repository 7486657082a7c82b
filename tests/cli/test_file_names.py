"""Files whose names are bytes and no text, as archives from other systems leave them, in every command."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from support.commands import run
from support.partial_captures import write_part
from support.point_captures import cells, point_light, points_header, write_points
from support.rendering import flat_wall

from nlosrender.capture.part import Selection
from nlosrender.config.load import load_config
from nlosrender.errors import EXIT_BAD_INPUT, EXIT_OK, ConfigError

NAME = os.fsdecode(b"caf\xe9")  # Latin-1, no UTF-8
RUN_ALL = """
import json, sys
from nlosrender.cli.app import main
for command in json.loads(sys.stdin.read()):
    sys.argv = ["nlosrender", *command]
    try:
        main()
        code = 0
    except SystemExit as end:
        code = end.code or 0
    sys.stdout.flush()
    print(code, *map(ascii, command), file=sys.stderr)
"""
COMMANDS = [
    ["info", f"{NAME}.hdf5", "--check"],
    ["info", f"{NAME}.hdf5", "--json"],
    ["plot", f"{NAME}.hdf5"],
    ["frames", f"{NAME}-view.hdf5"],
    ["frames", f"{NAME}-view.hdf5", "-o", f"{NAME}.gif"],
    ["reconstruct", f"{NAME}.hdf5", "--voxels", "6", "--png"],
    ["export", f"{NAME}.hdf5", "--format", "fk"],
    ["export", f"{NAME}.hdf5", "--format", "tal"],
    ["compare", f"{NAME}.hdf5", f"{NAME}.hdf5"],
    ["check", NAME, "--reference", NAME],
    ["merge", f"{NAME}/1.hdf5", f"{NAME}/2.hdf5", "-o", f"{NAME}-whole.hdf5"],
    ["validate", f"{NAME}.yaml"],
    ["new", f"{NAME}-new.yaml"],
]
WRITTEN = [
    *("-view-frames/frame-00000.exr", "-view-frames/steady.png", ".gif", ".png", "-phasor.hdf5", "-phasor.png"),
    *("-fk.mat", "-tal.hdf5", "-whole.hdf5", "-new.yaml"),
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder of captures and a configuration with such names."""
    try:
        (tmp_path / NAME).mkdir()
    except OSError:
        pytest.skip("this file system has names in UTF-8 only")
    sensors, points = cells(5, 3, 1.0, 0.8), [(0, 0, 0.8)]
    write_points(tmp_path / f"{NAME}.hdf5", points_header("confocal", sensors), points)
    view = points_header("line_of_sight", sensors, np.zeros((1, 1, 3)), bins=(0.0, 0.02, 200))
    write_points(tmp_path / f"{NAME}-view.hdf5", view, points)
    header = points_header("exhaustive", sensors)
    light = point_light(header, points)
    for number in (1, 2):
        half = Selection(shard=(number, 2))
        write_part(tmp_path / NAME / f"{number}.hdf5", header, np.stack([light, light])[None], half)
    (tmp_path / f"{NAME}.yaml").write_text(yaml.safe_dump(flat_wall()))
    return tmp_path


def test_every_command_takes_a_name_that_is_no_text(folder: Path) -> None:
    """Exit code 0, all outputs, and names on stdout byte for byte, where Python would refuse to print them."""
    environment = os.environ | {"PYTHONIOENCODING": "utf-8:strict"}  # as en_US.UTF-8 has it, and C.UTF-8 does not
    done = subprocess.run(
        [sys.executable, "-c", RUN_ALL],
        input=json.dumps(COMMANDS).encode(),
        cwd=folder,
        env=environment,
        capture_output=True,
        timeout=60,
        check=False,
    )
    told = done.stderr.decode()
    assert [line for line in told.splitlines() if line[:2] in ("1 ", "2 ", "3 ")] == [], told
    assert told.count("\n0 ") + told.startswith("0 ") == len(COMMANDS), told
    assert os.fsencode(f"wrote {NAME}-whole.hdf5 from 2 parts\n") in done.stdout
    assert [ending for ending in WRITTEN if not (folder / f"{NAME}{ending}").exists()] == []


def test_a_name_that_is_no_text_gives_one(folder: Path) -> None:
    """A capture that is named by its file has a name that YAML, HDF5 and the next file can hold."""
    for given, name in ((NAME, "caf-"), ("a\\b\n", "a-b-"), (" ", "capture"), ("plate", "plate")):
        path = folder / f"{given}.yaml"
        path.write_text(yaml.safe_dump(flat_wall()))
        config = load_config(path, [])
        assert (config.name, config.output.path) == (name, Path(f"{name}.hdf5"))


@pytest.mark.parametrize(
    ("item", "message"),
    [
        ({"type": "mesh", "filename": "no.obj"}, r"filename: got no.obj, but there is no file at .*caf.udce9"),
        (
            {"bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "filename": "t.png"}}},
            r"filename: got 't.png' \(text\); Mitsuba opens files with names in UTF-8 only, not .*caf.udce9/t.png",
        ),
    ],
)
def test_a_folder_that_mitsuba_cannot_open(folder: Path, item: dict[str, object], message: str) -> None:
    """Its files are refused with the reason, and with what to do."""
    plate = {"type": "rectangle", "width": 0.5, "height": 0.4, "center": [0, 0, 1], "normal": [0, 0, -1]}
    hidden = item if "type" in item else plate | item
    (folder / NAME / "t.png").touch()
    path = folder / NAME / "scene.yaml"
    path.write_text(yaml.safe_dump(flat_wall(hidden)))
    with pytest.raises(ConfigError, match=message):
        load_config(path, [])
    assert run(folder, "validate", f"{NAME}/scene.yaml").returncode == EXIT_BAD_INPUT


def test_a_mesh_in_such_a_folder_is_read(folder: Path) -> None:
    """Meshes are read here, by any name."""
    (folder / NAME / "triangle.obj").write_text("v -0.2 0.1 1.1\nv 0.2 0.1 1.1\nv 0 0.4 1.2\nf 1 3 2\n")
    scene = flat_wall({"type": "mesh", "filename": "triangle.obj"}, spp=8)
    (folder / NAME / "scene.yaml").write_text(yaml.safe_dump(scene))
    done = run(folder, "render", f"{NAME}/scene.yaml", "-o", f"{NAME}/out.hdf5", "--quiet")
    assert done.returncode == EXIT_OK, done.stderr
    assert (folder / NAME / "out.hdf5").exists()
