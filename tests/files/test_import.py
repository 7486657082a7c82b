"""Scene files of mitransient and y-tal as configurations: the same points, bins, surfaces and bounces, or a refusal."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from nlosrender.capture.grids import build_capture
from nlosrender.config.document import Config
from nlosrender.config.load import load_config, parse_config
from nlosrender.errors import ConfigError, OptionError
from nlosrender.files.importing.import_scene import import_scene
from nlosrender.files.importing.translation import Translation
from nlosrender.scene.transforms import transform_matrix
from nlosrender.scene.walls.wall_from_config import relay_wall_from_config

XML = """\
<scene version="3.0.0">
<integrator type="transient_nlos_path">
<boolean name="nlos_laser_sampling" value="True"/>
</integrator>
<emitter type="projector">
<rgb name="irradiance" value="1, 1, 1"/>
<transform name="to_world"><lookat origin="0.5, 0, 1" target="0.25, -0.5, 0" up="0, 1, 0"/></transform>
</emitter>
<shape type="rectangle" id="wall">
<transform name="to_world"><scale x="1.5" y="1"/></transform>
<bsdf type="diffuse"><rgb name="reflectance" value="0.5, 0.5, 0.5"/></bsdf>
<sensor type="nlos_capture_meter">
<point name="sensor_origin" x="-0.5" y="0.25" z="1"/>
<film type="transient_hdr_film">
<integer name="width" value="3"/>
<integer name="height" value="2"/>
</film>
</sensor>
</shape>
<shape type="rectangle" id="plate">
<transform name="to_world"><rotate y="1" angle="180"/><translate z="1"/></transform>
</shape>
</scene>
"""
YAML = """\
name: plate
sensor_width: 3
sensor_height: 2
geometry:
- name: plate
  mesh: {type: obj, filename: plate.obj}
  rot_degrees_x: 180
  displacement_z: 1.0
  material: {id: white}
- name: wall
  mesh: {type: rectangle}
  displacement_x: 0.25
  scale_x: 1.5
  material: {id: white}
relay_wall: wall
"""
PLATE = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nf 1 2 3\n"


def imported(folder: Path, text: str, **options: object) -> tuple[Translation, str]:
    """Import a text from a folder that holds plate.obj."""
    (folder / "plate.obj").write_text(PLATE)
    path = folder / ("scene.xml" if text.startswith("<") else "scene.yaml")
    path.write_text(text)
    return import_scene(path, folder / "capture.yaml", **options)


def config_of(folder: Path, text: str, **options: object) -> Config:
    """Return the configuration of a text that has no mistakes."""
    translation, content = imported(folder, text, **options)
    assert not translation.issues
    return parse_config(content, "capture.yaml", folder)


def points(config: Config, grid: str = "sensor_grid") -> np.ndarray:
    """Return the points of a grid in the scene, (ny, nx, 3) [m]."""
    wall = relay_wall_from_config(config.scene.relay_wall)
    return wall.pose.to_scene(getattr(build_capture(config.capture, wall), grid).positions)


def test_mitransients_defaults_are_those_of_its_sources(tmp_path: Path) -> None:
    """What a file leaves out is what mitransient takes for it, not what nlosrender would."""
    config = config_of(tmp_path, XML.replace('<boolean name="nlos_laser_sampling" value="True"/>\n', ""))
    axis = config.time_axis
    assert (axis.n_bins, axis.bin_width_opl, axis.start_opl) == (2048, 0.003, 0.0)
    assert (config.capture.scan_type, config.capture.account_first_and_last_bounces) == ("single", False)
    assert config.render.max_bounces == 5  # max_depth 6, without the connection to the laser point
    assert config.scene.hidden_geometry[0].bsdf["reflectance"] == 0.5  # Mitsuba's where there is no BSDF


def test_ytals_defaults_are_those_of_its_sources(tmp_path: Path) -> None:
    """What a file leaves out, or has null for, is what y-tal takes for it."""
    text = YAML.replace("sensor_width: 3\nsensor_height: 2\n", "num_bins: null\n")
    config = config_of(tmp_path, text)
    axis, grid = config.time_axis, config.capture.sensor_grid
    assert (axis.n_bins, axis.bin_width_opl, axis.start_opl) == (4096, 0.003, 0.0)
    assert (grid.nx, grid.ny, config.capture.scan_type) == (256, 256, "single")
    assert config.capture.laser_position == config.capture.sensor_position == (-0.5, 0.0, 0.25)
    assert config.render.max_bounces is None
    assert config.capture.account_first_and_last_bounces is False


@pytest.mark.parametrize(
    ("keys", "bounces"),
    [
        ({"max_depth": -1}, None),
        ({"max_depth": 4}, 4),
        ({"max_depth": 4, "nlos_laser_sampling": "false"}, 3),
        ({"filter_bounces": 2}, 3),  # of its loop: the third bounce
        ({"filter_bounces": 3}, 4),
        ({"filter_depth": 3}, 3),
        ({"filter_bounces": 1, "nlos_laser_sampling": "false"}, 3),
    ],
)
def test_bounces_are_counted_by_surfaces(tmp_path: Path, keys: dict[str, object], bounces: int | None) -> None:
    """The depth of mitransient's loop at which a path of n surfaces is added up depends on the laser sampling."""
    text = XML
    if "nlos_laser_sampling" in keys:
        text = text.replace('<boolean name="nlos_laser_sampling" value="True"/>\n', "")
    tags = {"nlos_laser_sampling": "boolean"}
    elements = "".join(f'<{tags.get(key, "integer")} name="{key}" value="{keys[key]}"/>' for key in keys)
    text = text.replace("</integrator>", f"{elements}</integrator>")
    assert config_of(tmp_path, text).render.max_bounces == bounces


@pytest.mark.parametrize(
    ("steps", "is_mirrored"),
    [
        ('<scale x="1.5" y="0.5"/>', False),
        ('<scale x="1.5" y="0.5"/><rotate x="1" angle="30"/><translate x="0.2" y="-0.1" z="-2"/>', False),
        ('<scale x="-1" y="0.5"/>', True),
        ('<scale x="-1" y="-0.5"/>', False),
    ],
)
def test_points_of_the_relay_wall_are_pixel_centres_in_uv(tmp_path: Path, steps: str, is_mirrored: bool) -> None:
    """Point (i, j) is where the shape has u = (i + 1/2) / width, v = (j + 1/2) / height; mirrored: counted back."""
    text = XML.replace('<scale x="1.5" y="1"/></transform>', f"{steps}</transform>")
    text = text.replace('y="0.25" z="1"/>', 'y="0.25" z="9"/>').replace("0.5, 0, 1", "0.5, 0, 9")
    config = config_of(tmp_path, text, laser=(0.1, 0.2))
    matrix = np.eye(4)
    for tag, value in re.findall(r"<(\w+) ([^/]*)/>", steps):
        number = {axis: float(x) for axis, x in re.findall(r'(\w+)="([^"]*)"', value)}
        if tag == "rotate":
            step: object = [{"rotate": {"axis": [1, 0, 0], "angle_deg": number["angle"]}}]
        else:
            step = [{tag: [number.get(axis, float(tag == "scale")) for axis in "xyz"]}]
        matrix = transform_matrix(step) @ matrix
    u, v = np.meshgrid((np.arange(3) + 0.5) / 3, (np.arange(2) + 0.5) / 2)
    expected = np.stack([2 * u - 1, 2 * v - 1, 0 * u, 1 + 0 * u], axis=-1) @ matrix.T
    expected = expected[:, ::-1] if is_mirrored else expected
    assert points(config) == pytest.approx(expected[..., :3], abs=1e-9)


def test_the_laser_point_is_where_the_projector_looks(tmp_path: Path) -> None:
    """The axis of a lookat meets the wall at its target; --laser wins; older files name a pixel of the film."""
    assert config_of(tmp_path, XML).capture.laser_point == pytest.approx((0.25, -0.5))
    assert config_of(tmp_path, XML).capture.laser_position == pytest.approx((0.5, 0.0, 1.0))
    assert config_of(tmp_path, XML, laser=(0.5, 0.25)).capture.laser_point == (0.5, 0.25)
    text = re.sub(r"<transform name=\"to_world\"><lookat.*\n", "", XML)
    old = '<point name="laser_origin" x="0" y="0" z="2"/><point name="laser_lookat_pixel" x="2" y="0.5" z="0"/>'
    config = config_of(tmp_path, text.replace("<film", f"{old}<film"))
    assert config.capture.laser_point == pytest.approx((0.5, -0.5))  # of 3 x 2 m and 3 x 2 pixels, from the centre
    assert config.capture.laser_position == (0.0, 0.0, 2.0)


def test_legs_of_older_files_are_the_sensors(tmp_path: Path) -> None:
    """The integrator decides; where it is silent, the sensor of a file for an older version does."""
    key = '<boolean name="account_first_and_last_bounces" value="{}"/>'
    old = XML.replace("<film", key.format("True") + "<film")
    assert config_of(tmp_path, old).capture.account_first_and_last_bounces is True
    both = old.replace("</integrator>", key.format("false") + "</integrator>")
    assert config_of(tmp_path, both).capture.account_first_and_last_bounces is False


def test_scans_of_mitransient(tmp_path: Path) -> None:
    """capture_type is a number or a name; older files say confocal, or give the film of points measured one by one."""
    for element, scan in (
        ('<integer name="capture_type" value="2"/>', "confocal"),
        ('<string name="capture_type" value="Exhaustive"/>', "exhaustive"),
    ):
        config = config_of(tmp_path, XML.replace("</integrator>", f"{element}</integrator>"))
        assert config.capture.scan_type == scan
        lasers = points(config, "laser_grid")
        assert lasers == pytest.approx(points(config))
    by_point = '<integer name="original_film_width" value="5"/><integer name="original_film_height" value="4"/>'
    config = config_of(tmp_path, XML.replace("<film", f"{by_point}<film"))
    assert (config.capture.scan_type, config.capture.sensor_grid.nx, config.capture.sensor_grid.ny) == (
        "confocal",
        5,
        4,
    )
    with pytest.raises(OptionError, match="a confocal capture has no single laser point"):
        imported(tmp_path, XML.replace("<film", f"{by_point}<film"), laser=(0, 0))


def test_a_camera_stays_a_mitsuba_scene(tmp_path: Path) -> None:
    """A transient_path before a perspective sensor is a line-of-sight capture of the same file."""
    text = """<scene version="3.0.0"><integrator type="transient_path"><boolean name="camera_unwarp" value="true"/>
    <integer name="max_depth" value="3"/></integrator><emitter type="point"/><shape type="sphere"/>
    <sensor type="perspective"><film type="transient_hdr_film"><integer name="width" value="4"/>
    <integer name="height" value="3"/><integer name="temporal_bins" value="7"/></film></sensor></scene>"""
    config = config_of(tmp_path, text)
    grid = config.capture.sensor_grid
    assert (config.capture.scan_type, grid.nx, grid.ny, config.time_axis.n_bins) == ("line_of_sight", 4, 3, 7)
    assert config.render.max_bounces == 2
    assert config.capture.account_first_and_last_bounces is False
    assert config.scene.mitsuba == tmp_path / "scene.xml"


PIXELS = """<scene version="3.0.0"><integrator type="transient_nlos_path">
<boolean name="nlos_laser_sampling" value="true"/><string name="capture_type" value="SCAN"/></integrator>
<emitter type="projector"><transform name="to_world"><lookat origin="0.5, 0, 2" target="0.25, 0.125, 0" up="0, 1, 0"/>
</transform></emitter><shape type="rectangle"/>
<sensor type="perspective"><float name="fov" value="30"/><film type="transient_hdr_film">
<integer name="width" value="4"/><integer name="height" value="3"/><integer name="temporal_bins" value="7"/></film>
</sensor></scene>"""


@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
def test_a_camera_before_a_hidden_scene(tmp_path: Path, scan: str) -> None:
    """Its pixels' first surfaces are the points; the laser stands where the projector does and looks along its axis."""
    config = config_of(tmp_path, PIXELS.replace("SCAN", scan))
    capture = config.capture
    assert (capture.scan_type, capture.sensor_grid.nx, capture.sensor_grid.ny) == (scan, 4, 3)
    assert config.scene.mitsuba == tmp_path / "scene.xml"
    assert config.has_pixel_points
    assert capture.laser_position == pytest.approx((0.5, 0, 2))
    if scan == "single":
        towards = np.subtract(capture.laser_target, capture.laser_position)
        assert towards / np.abs(towards[2]) == pytest.approx(np.array([-0.125, 0.0625, -1]))
        assert capture.pixel_point is None
    else:
        assert capture.pixel_point == (0, 1)  # the upper left corner, where mitransient's laser looks
    assert capture.n_lasers == (12 if scan == "exhaustive" else 1)
    assert capture.footprint is not None  # mitransient's pixels see areas
    assert capture.footprint.pixel


SCANNED = '<integer name="laser_scan_width" value="3"/><integer name="laser_scan_height" value="2"/>'


def test_a_fan_of_rays(tmp_path: Path) -> None:
    """The laser's targets lie on the rays of a projector of its own field of view, from the upper left, at i / N."""
    fan = '<boolean name="force_equal_illumination_scanning" value="false"/>'
    fan += '<float name="illumination_scan_fov" value="90"/></integrator>'
    text = PIXELS.replace("SCAN", "exhaustive").replace("</integrator>", fan).replace("</film>", f"{SCANNED}</film>")
    place = '<transform name="to_world"><lookat origin="0, 0, 2" target="0, 0, 0" up="0, 1, 0"/></transform>'
    config = config_of(tmp_path, re.sub(r"<transform.*?</transform>", place, text, count=1, flags=re.DOTALL))
    # looking along -z with +y up, right is +x: u = 0, 1/3, 2/3 from the left edge, v = 0, 1/2 from the top
    expected = [[x, y, 1] for y in (1, 0) for x in (-1, -1 / 3, 1 / 3)]
    assert np.array(config.capture.laser_targets) == pytest.approx(np.array(expected))
    assert config.capture.n_lasers == 6
    assert config.capture.pixel_point is None


def test_what_a_camera_before_a_hidden_scene_cannot_have(tmp_path: Path) -> None:
    """A laser point of a wall, a laser grid of another size, another lamp: refused with the reason."""
    _refused(tmp_path, PIXELS.replace("SCAN", "single"), "is a point of a relay wall", laser=(0.0, 0.0))
    for old, new, message in (
        ('name="fov"', 'name="fow"', "5: sensor.fow: unknown here; remove it if it does not matter. Did you mean fov"),
        ('"temporal_bins"', '"temporal_bin"', "6: film.temporal_bin: unknown here"),
        ('value="30"', 'value="3O"', "5: sensor.fov: got '3O' (text), need a finite number"),
        ('origin="0.5, 0, 2"', 'origin="0.5, 0"', "3: lookat: got <lookat origin='0.5, 0'"),
    ):
        _refused(tmp_path, PIXELS.replace("SCAN", "single").replace(old, new, 1), f"scene.xml:{message}")
    exhaustive = PIXELS.replace("SCAN", "exhaustive")
    wider = exhaustive.replace("</film>", f"{SCANNED}</film>")
    _refused(tmp_path, wider, "need film.width (4): laser points are the pixels' points")
    _refused(tmp_path, exhaustive.replace("projector", "point"), "is lit by one <emitter type='projector'>")


def _refused(tmp_path: Path, text: str, message: str, **options: object) -> None:
    translation, _ = imported(tmp_path, text, **options)
    assert message in str(ConfigError(translation.issues))


def test_points_of_ytal(tmp_path: Path) -> None:
    """Sensor points are cell centres of the wall; the laser looks at a place in pixels, or at the middle."""
    config = config_of(tmp_path, YAML + "laser_lookat_x: 1\nlaser_lookat_y: 0\n")
    x, y = np.meshgrid([-1.0, 0.0, 1.0], [-0.5, 0.5])
    assert points(config) == pytest.approx(np.stack([x + 0.25, y, 0 * x], axis=-1))
    assert config.capture.laser_point == pytest.approx((-0.5, 0.0))  # 1 of 3 pixels on 3 m; 0 is no value there
    assert config_of(tmp_path, YAML, laser=(0.5, -0.25)).capture.laser_point == (0.5, -0.25)


def test_apertures_of_ytal(tmp_path: Path) -> None:
    """The laser grid of an exhaustive scan covers its aperture, in shares of the wall."""
    aperture = "laser_aperture_start_x: 0.1\nlaser_aperture_end_x: 0.9\n"
    text = f"{YAML}scan_type: exhaustive\nlaser_width: 4\nlaser_height: 5\n{aperture}"
    lasers = points(config_of(tmp_path, text), "laser_grid")
    assert lasers[0, :, 0] == pytest.approx(0.25 + 1.2 * np.array([-0.75, -0.25, 0.25, 0.75]))
    assert lasers[:, 0, 1] == pytest.approx([-0.8, -0.4, 0.0, 0.4, 0.8])
    found = config_of(tmp_path, text.replace("laser_aperture_end_x: 0.9", "laser_aperture_end_x: 0.5")).capture
    x, y = np.meshgrid(3 * (np.array([0.15, 0.25, 0.35, 0.45]) - 0.5), [-0.8, -0.4, 0.0, 0.4, 0.8])
    assert np.array(found.laser_points) == pytest.approx(np.stack([x, y], axis=-1).reshape(-1, 2))
    assert found.laser_grid is None


def test_shapes_of_ytal(tmp_path: Path) -> None:
    """Shapes are scaled, turned about x, y and z, and moved, in this order; 1_000 is a number of YAML 1.1."""
    text = YAML.replace("  rot_degrees_x: 180\n", "  rot_degrees_x: 90\n  rot_degrees_z: 90\n  scale_y: 2\n")
    config = config_of(tmp_path, text + "num_bins: 1_000\n")
    matrix = transform_matrix(config.scene.hidden_geometry[0].shape["to_world"])
    assert matrix @ [0, 1, 0, 1] == pytest.approx([0, 0, 3, 1])  # y: 2 y: 2 z: 2 z: moved by 1
    assert matrix @ [1, 0, 0, 1] == pytest.approx([0, 1, 1, 1])
    assert config.time_axis.n_bins == 1000


def test_samples_are_a_comment(tmp_path: Path) -> None:
    """Their number has no counterpart beside an error to reach: it is said, and refuses nothing."""
    for text, said in (("sample_count: 2_000\n", "there 2_000 samples"), ("", "there 1_000_000 samples")):
        assert f"target_error: 0.05}}  # {said} per point" in imported(tmp_path, YAML + text)[1]
    sampler = '<sampler type="independent"><integer name="sample_count" value="{}"/></sampler><film'
    assert "# there 64 samples" in imported(tmp_path, XML.replace("<film", sampler.format(64)))[1]
    assert not imported(tmp_path, XML.replace("<film", sampler.format("$spp")))[0].issues


@pytest.mark.parametrize(
    ("material", "bsdf"),
    [
        ("{id: white}", {"type": "diffuse", "reflectance": 1.0}),
        ("{id: copper, alpha: '0.2'}", {"type": "roughconductor", "material": "Cu", "distribution": "beckmann"}),
        (
            """{id: custom, text: '<bsdf type="twosided"><bsdf type="diffuse"/></bsdf>'}""",
            {"type": "twosided", "bsdf0": {"type": "diffuse", "reflectance": 0.5}},
        ),
    ],
)
def test_materials_of_ytal(tmp_path: Path, material: str, bsdf: dict[str, object]) -> None:
    """Three kinds, one of them any BSDF in Mitsuba's XML."""
    config = config_of(tmp_path, YAML.replace("{id: white}", material, 1))
    assert bsdf.items() <= config.scene.hidden_geometry[0].bsdf.items()


def test_materials_of_mitransient(tmp_path: Path) -> None:
    """References, nested BSDFs, textures and spectra; of a two-sided relay wall the side that is lit."""
    shared = """<bsdf type="twosided" id="both"><bsdf type="roughconductor"><float name="alpha" value="0.2"/>
    <spectrum name="specular_reflectance" value="0.8"/></bsdf></bsdf>"""
    picture = """<bsdf type="diffuse"><texture type="checkerboard" name="reflectance"><rgb name="color0" value="1 0 0"/>
    <transform name="to_uv"><scale x="2" y="2" z="1"/></transform></texture></bsdf>"""
    text = XML.replace(
        '<shape type="rectangle" id="plate">', f'{shared}<shape type="rectangle" id="plate"><ref id="both"/>'
    )
    text = text.replace('<bsdf type="diffuse"><rgb name="reflectance" value="0.5, 0.5, 0.5"/></bsdf>\n', picture)
    scene = config_of(tmp_path, text).scene
    inner = scene.hidden_geometry[0].bsdf["bsdf0"]
    assert (inner["alpha"], inner["specular_reflectance"]) == (0.2, 0.8)
    texture = scene.relay_wall.bsdf["reflectance"]
    assert (list(texture["color0"]), texture["to_uv"][0]["scale"]) == ([1.0, 0.0, 0.0], (2.0, 2.0, 1.0))
    lit = '<bsdf type="twosided"><bsdf type="diffuse"/></bsdf>'
    wall = XML.replace('<bsdf type="diffuse"><rgb name="reflectance" value="0.5, 0.5, 0.5"/></bsdf>', lit)
    assert config_of(tmp_path, wall).scene.relay_wall.bsdf["type"] == "diffuse"


def test_file_names_start_at_the_folder_of_the_configuration(tmp_path: Path) -> None:
    """Relative ones stay relative, from wherever the configuration is; absolute ones stay as they are."""
    (tmp_path / "meshes").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "meshes/plate.obj").write_text(PLATE)
    for name in ("meshes/plate.obj", str(tmp_path / "meshes/plate.obj")):
        shape = f'<shape type="obj" id="p"><string name="filename" value="{name}"/></shape></scene>'
        (tmp_path / "scene.xml").write_text(XML.replace("</scene>", shape))
        translation, content = import_scene(tmp_path / "scene.xml", tmp_path / "out/capture.yaml")
        assert not translation.issues
        (tmp_path / "out/capture.yaml").write_text(content)
        config = load_config(tmp_path / "out/capture.yaml")
        assert Path(config.scene.hidden_geometry[1].shape["filename"]) == tmp_path / "meshes/plate.obj"
        assert (f"filename: {name}" if name.startswith("/") else "filename: ../meshes/plate.obj") in content


def test_meshes_of_ytal_start_where_it_was_started(tmp_path: Path) -> None:
    """The file's folder, the one above it, as y-tal is started on a folder, or the one that is named."""
    (tmp_path / "plate").mkdir()
    config = config_of(tmp_path / "plate", YAML)
    (tmp_path / "plate/plate.obj").rename(tmp_path / "plate.obj")
    above = import_scene(tmp_path / "plate/scene.yaml", tmp_path / "plate/capture.yaml")
    assert "filename: ../plate.obj" in above[1]
    (tmp_path / "far").mkdir()
    (tmp_path / "plate.obj").rename(tmp_path / "far/plate.obj")
    named = import_scene(tmp_path / "plate/scene.yaml", tmp_path / "plate/capture.yaml", meshes=tmp_path / "far")
    assert "filename: ../far/plate.obj" in named[1]
    lost = import_scene(tmp_path / "plate/scene.yaml", tmp_path / "plate/capture.yaml")[0]
    assert "--meshes FOLDER" in str(ConfigError(lost.issues))
    assert config.name == "plate"


INTEGRATOR = "</integrator>"
REFUSED_XML = [  # what is replaced, by what, where it is told, and how
    (
        "transient_nlos_path",
        "timegated_transient_path",
        2,
        "integrator: .*need transient_nlos_path or .*transient_path",
    ),
    (
        '"nlos_capture_meter"',
        '"radiancemeter"',
        12,
        "sensor: is not known here; need nlos_capture_meter or perspective",
    ),
    ('"transient_hdr_film"', '"phasor_hdr_film"', 14, "film.type: stores frequencies"),
    ('"transient_hdr_film"', '"hdrfilm"', 14, "film.type: no film with a time axis"),
    ('type="projector"', 'type="angulararea"', 5, "emitter.* type='angulararea'> is not supported"),
    ('type="projector"', 'type="spot"', 5, "emitter: an NLOS scene is lit by one"),
    ('type="diffuse"', 'type="velvet"', 11, "type='velvet'> is not supported"),
    ('type="rectangle" id="plate"', 'type="teapot" id="plate"', 20, "type='teapot'> is not supported"),
    ('type="rectangle" id="wall"', 'type="sphere" id="wall"', 9, "is in a sphere; points lie at"),
    ("nlos_laser_sampling", "nlos_lazer_sampling", 3, "unknown here.* Did you mean nlos_laser_sampling"),
    ('name="width"', 'name="crop_width"', 15, "a part of a film is not read"),
    ('value="3"/>', 'value="3.5"/>', 15, "film.width: got '3.5' .text., need an integer"),
    ('value="2"/>', 'value=""/>', 16, "film.height: got '' .text., need an integer"),
    ('value="3"/>', 'value="0"/>', 15, "capture.sensor_grid.nx: got 0, need an integer >= 1"),
    ('target="0.25', 'target="9', 7, "does not look at the relay wall; say it with --laser X,Y"),
    ('z="1"/>\n<film', 'z="-1"/>\n<film', 13, "capture.sensor_position: .* behind the relay wall"),
    ('<scale x="1.5" y="1"/>', '<scale value="0"/>', 9, "to_world.*none of them 0"),
    ("<rgb", '<texture type="checkerboard" name="irradiance"/><rgb', 6, "irradiance: a projected picture"),
    ("</scene>", '<emitter type="projector"/></scene>', 23, "emitter: an NLOS scene is lit by one"),
    ("</scene>", '<integrator type="transient_nlos_path"/></scene>', 23, "integrator: the scene has 2 of them"),
    ("</scene>", '<medium type="homogeneous"/></scene>', 23, "participating media are not rendered"),
    (
        INTEGRATOR,
        f'<integer name="capture_type" value="4"/>{INTEGRATOR}',
        4,
        "need one of single, confocal, exhaustive",
    ),
    (INTEGRATOR, f'<integer name="filter_bounces" value="0"/>{INTEGRATOR}', 4, "keeps bounce 1 alone"),
    (INTEGRATOR, f'<integer name="max_depth" value="1"/>{INTEGRATOR}', 4, "render.max_bounces: got 1, need"),
    (INTEGRATOR, f'<boolean name="camera_unwarp" value="true"/>{INTEGRATOR}', 4, "is for cameras"),
    ("</scene>", "<scene>", 24, "not well-formed XML"),
    ("<scene", "<!DOCTYPE s [<!ENTITY a 'b'>]><scene", 1, "document type or entities"),
    ("</scene>", "<shape type='cube'>" * 70, 23, "more than 64 deep"),
    ('x="1.5" y="1"', 'x="1.5" y="1O"', 10, "scale: got <scale x='1.5' y='1O'>, need translate, rotate"),
    ('x="1.5" y="1"', 'x="1.5" Y="1"', 10, "scale: got <scale x='1.5' Y='1'>, need translate, rotate"),
    ('<scale x="1.5" y="1"/>', '<skale x="1.5"/>', 10, "skale> is not supported"),
    ('value="2"/>', 'value="2"/><integer name="height" value="4"/>', 16, "height is given a second time"),
    ("</shape>\n</scene>", '<boolean name="flip_normals" value="no"/></shape>\n</scene>', 22, "need true or false"),
    ('<film type="transient_hdr_film">', "", 17, "not well-formed XML: mismatched tag"),
]


@pytest.mark.parametrize(("old", "new", "line", "message"), REFUSED_XML)
def test_what_mitransient_means_otherwise_is_refused(
    tmp_path: Path, old: str, new: str, line: int | None, message: str
) -> None:
    """Nothing without which the capture would be another one is dropped: file, line and reason."""
    translation, _ = imported(tmp_path, XML.replace(old, new, 1))
    place = re.escape(f"{tmp_path / 'scene.xml'}") + ("" if line is None else f":{line}: ")
    assert re.search(f"{place}.*{message}", str(ConfigError(translation.issues)))


def test_a_fan_of_rays_on_a_wall(tmp_path: Path) -> None:
    """Its laser points are where the rays meet the wall, in their order; one that misses it is told."""
    kind = '<integer name="capture_type" value="3"/>'
    fan = '<boolean name="force_equal_illumination_scanning" value="false"/><float name="illumination_scan_fov" '
    text = XML.replace('target="0.25, -0.5, 0"', 'target="0.5, 0, 0"')  # from 1 m, straight at the wall
    text = text.replace("</film>", f"{SCANNED}</film>")
    found = config_of(tmp_path, text.replace(INTEGRATOR, f'{kind}{fan}value="53.130102354"/>{INTEGRATOR}'))
    expected = [[x, y] for y in (0.5, 0.0) for x in (0.0, 1 / 3, 2 / 3)]  # half a metre to each side, at i / N
    assert np.array(found.capture.laser_points) == pytest.approx(np.array(expected), abs=1e-9)
    _refused(
        tmp_path, text.replace(INTEGRATOR, f'{kind}{fan}value="130"/>{INTEGRATOR}'), "rays of its fan miss the wall"
    )
    wide = XML.replace(INTEGRATOR, kind + INTEGRATOR)
    _refused(
        tmp_path, wide.replace("</film>", '<integer name="laser_scan_width" value="7"/></film>'), "got 7, need film.w"
    )


REFUSED_YAML = [
    (YAML, "name: x", ":1: geometry: got nothing"),
    ("name: plate\n", "nmae: plate\n", "1:7: nmae: unknown here.*Did you mean name"),
    ("sensor_width: 3", "sensor_width: wide", "2:15: sensor_width: got 'wide'"),
    ("sensor_width: 3", "sensor_width: 0", "2:15: capture.sensor_grid.nx: got 0, need an integer >= 1"),
    ("sensor_width: 3", "scan_type: spiral", "2:12: scan_type: need single"),
    ("sensor_width: 3", "histogram_mode: frequency", "2:17: histogram_mode: stores frequencies"),
    ("sensor_width: 3", "mitsuba_variant: llvm_ad_spectral", "2:18: mitsuba_variant: renders spectra"),
    ("sensor_width: 3", "sensor_z: -1", "2:11: capture.sensor_position: .*behind the relay wall"),
    ("{type: obj, filename: plate.obj}", "{type: cube}", "6:16: geometry.plate.mesh.type|type: need obj"),
    ("plate.obj", "lost.obj", "6:.*filename: is not there"),
    ("{type: rectangle}", "{type: sphere}", r"geometry.wall.mesh.type: points lie at \(u, v\)"),
    ("{id: white}", "{id: gold}", "9:.*id: got 'gold' .text., need white, copper or custom"),
    ("{id: white}", "{id: copper}", "9:.*alpha: copper needs it"),
    ("{id: white}", "{id: custom, text: <bsdf type='velvet'/>}", "9:.*text: .*velvet.*is not supported"),
    ("  displacement_z: 1.0", "  displacement: 1.0", "8:.*displacement: unknown here"),
    ("relay_wall: wall", "relay_wall: hall", "15:13: relay_wall: is none of the names"),
    ("sensor_width: 3", "scan_type: exhaustive\nlaser_aperture_end_x: 1.5", "3:23: .*from 0 to 1.5, need 0 <= start"),
]


@pytest.mark.parametrize(("old", "new", "message"), REFUSED_YAML)
def test_what_ytal_means_otherwise_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    """Nothing without which the capture would be another one is dropped: file, line, column and reason."""
    translation, _ = imported(tmp_path, YAML.replace(old, new, 1))
    assert re.search(message, str(ConfigError(translation.issues)))
    assert all(issue.place.startswith(str(tmp_path / "scene.yaml:")) for issue in translation.issues)


def test_a_blur_in_time_is_told(tmp_path: Path) -> None:
    """Without temporal_filter mitransient blurs time by the film's filter, a Gaussian unless the file has a box."""
    box, filtered = '<rfilter type="box"/></film>', '<string name="temporal_filter" value="{}"/>'
    for old, new, is_told in (
        ("</film>", box, False),
        ("</film>", "</film>", True),
        (INTEGRATOR, filtered.format("box") + INTEGRATOR, False),
        (INTEGRATOR, filtered.format("gaussian") + INTEGRATOR, True),
    ):
        lines = imported(tmp_path, XML.replace(old, new))[0].lines
        assert any("in time" in line.remark and line.verdict == "changed" for line in lines) == is_told


def test_known_biases_are_told(tmp_path: Path) -> None:
    """Where the file asks for what mitransient gets wrong, the report says how its H differs."""
    key = '<boolean name="nlos_hidden_geometry_sampling" value="true"/>'
    translation, _ = imported(tmp_path, XML.replace(INTEGRATOR, key + INTEGRATOR))
    notes = " ".join(line.remark for line in translation.lines if line.verdict == "note")
    for part in ("one factor per laser point", "occluded", "bounces 5 and up"):
        assert part in notes
    notes = " ".join(line.remark for line in imported(tmp_path, XML)[0].lines if line.verdict == "note")
    assert "occluded" not in notes
    mixed = key + key.replace("sampling", "sampling_do_rroulette")
    notes = " ".join(line.remark for line in imported(tmp_path, XML.replace(INTEGRATOR, mixed + INTEGRATOR))[0].lines)
    assert "doubles its light" in notes
    ytal = imported(tmp_path, YAML + "integrator_nlos_hidden_geometry_sampling: true\n")[0]
    notes = " ".join(line.remark for line in ytal.lines if line.verdict == "note")
    assert "occluded" in notes
    assert "bounces 5" not in notes  # y-tal samples the relay wall unless it is told not to
