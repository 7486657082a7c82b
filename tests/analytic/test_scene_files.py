"""Whole Mitsuba scenes from XML: the same light as from the YAML of the same scene, and no shape that is not there."""

from __future__ import annotations

import gc
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.rendering import configured, flat_wall
from support.views import View, see, view_config

from nlosrender.config.bsdf_table import MEDIA, METALS
from nlosrender.config.document import Config
from nlosrender.config.mitsuba_xml import read_mitsuba_xml
from nlosrender.config.xml_shapes import placement
from nlosrender.engine.backend.start import start_backend
from nlosrender.errors import ConfigError
from nlosrender.rendering import stages
from nlosrender.scene.transforms import transform_matrix

PINHOLE = {"fov_deg": 0.01}  # what is seen is a point: 0.7 mm across at 4 m
LAMP = {"type": "point", "position": [0, 0, 0], "intensity": 1.0}
GLASS = {"type": "roughdielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": 0.03}
EVEN = {"type": "uniform", "value": 0.5}  # neither bumps nor slopes
NESTED: dict[str, dict[str, Any]] = {
    "blend": {"type": "blendbsdf", "weight": 0.5, "a": GLASS, "b": {"type": "diffuse"}},
    "mask": {"type": "mask", "opacity": 1.0, "inner": GLASS},
    "bumps": {"type": "bumpmap", "map": EVEN, "inner": GLASS},
    "deep": {"type": "bumpmap", "map": EVEN, "inner": {"type": "mask", "opacity": 1.0, "inner": GLASS}},
}


def write_scene(folder: Path, content: str) -> str:
    """Write a scene whose first element stands in line 2; return its name."""
    (folder / "scene.xml").write_text(f"<scene version='3.0.0'>\n{content}\n</scene>\n", encoding="utf-8")
    return "scene.xml"


def seen(folder: Path, content: str, **options: Any) -> View:
    """Render a scene file, by default lit by a point at the origin."""
    config = view_config(**({"emitters": [LAMP], "spp": 16} | options), scene={"mitsuba": write_scene(folder, content)})
    return see(config, folder=folder)


@pytest.mark.parametrize("name", NESTED)
def test_glass_inside_other_materials_delays_connections_too(name: str) -> None:
    """What crosses a pane of index 1.5 and thickness 0.5 m on its way to a lamp is 0.25 m late, whatever holds it."""
    pane = {"type": "box", "center": [0, 0, 1.9], "size": [3, 3, 0.5], "bsdf": NESTED[name]}
    view = see(view_config(pane, emitters=[LAMP], camera=PINHOLE, bins=(3.0, 0.01, 300), max_bounces=2, spp=16384))
    histogram = view.mean[0, 2].sum(axis=(0, 1))
    first = round((4 + 0.25 - 3.0) / 0.01)
    assert histogram.sum() > 0
    assert not histogram[: first - 1].any()
    assert histogram[first - 1 : first + 5].sum() > 0.9 * histogram.sum()  # slopes of 0.03 bend it by little


def test_glass_in_a_blend_of_a_scene_file(tmp_path: Path) -> None:
    """The index is found in XML as in YAML, and that of a wrapped BSDF that lets nothing through is 1."""
    blend = """<shape type='cube'><bsdf type='blendbsdf'><float name='weight' value='0.5'/>
      <bsdf type='roughdielectric'><float name='int_ior' value='1.3'/><float name='ext_ior' value='1'/></bsdf>
      <bsdf type='diffuse'/></bsdf></shape>
      <shape type='sphere'><bsdf type='twosided'><bsdf type='principled'/></bsdf></shape>"""
    view = seen(tmp_path, blend)
    from nlosrender.engine.line_of_sight.view_params import refractive_indices

    indices = np.array(refractive_indices(view.engine.built.scene))
    assert indices[indices != 1].tolist() == [pytest.approx(1.3)]


@pytest.mark.parametrize("second", [{**GLASS, "int_ior": 1.3}, {"type": "principledthin", "diff_trans": 1.0}])
def test_two_media_behind_one_surface_are_refused(second: dict[str, Any]) -> None:
    """No one optical path belongs to a connection across it."""
    ball = {"type": "sphere", "center": [0, 0, 0], "radius": 0.5}
    ball |= {"bsdf": {"type": "blendbsdf", "weight": 0.5, "a": GLASS, "b": second}}
    with pytest.raises(ConfigError, match=r"refractive indices 1(\.3)? and 1\.5, need one medium") as caught:
        see(view_config(ball, emitters=[LAMP], spp=1))
    assert caught.value.issues[0].key == "scene.hidden_geometry.0.bsdf"


HALF = {"type": "checkerboard", "color0": 1.0, "color1": 0.5}


@pytest.mark.parametrize(
    ("bsdf", "warns"),
    [
        ({"type": "mask", "opacity": 0.5, "inner": GLASS}, True),
        ({"type": "mask", "opacity": 0.5, "inner": {"type": "dielectric"}}, True),
        ({"type": "mask", "opacity": HALF, "inner": GLASS}, True),
        ({"type": "bumpmap", "map": EVEN, "inner": {"type": "mask", "opacity": 0.5, "inner": GLASS}}, True),
        ({"type": "blendbsdf", "weight": 0.5, "a": GLASS, "b": {"type": "null"}}, True),
        ({"type": "mask", "opacity": 0.5, "inner": {"type": "plastic"}}, False),
        ({"type": "mask", "opacity": 1.0, "inner": GLASS}, False),
        ({"type": "mask", "opacity": 0.0, "inner": GLASS}, False),
        ({"type": "mask", "opacity": HALF | {"color1": 1.0}, "inner": {"type": "dielectric"}}, False),
        ({"type": "blendbsdf", "weight": 0.0, "a": GLASS, "b": {"type": "null"}}, False),
        ({"type": "blendbsdf", "weight": 1.0, "a": GLASS, "b": {"type": "null"}}, False),
    ],
)
def test_glass_that_lets_light_in_unbent_is_warned_about(bsdf: dict[str, Any], warns: bool) -> None:
    """Behind the hole of a mask light has no index of refraction going in and one coming out: it would outrun itself.

    Where nothing is a hole, or all of it, there is nothing to say.
    """
    ball = {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.3, "bsdf": bsdf}
    view = configured(view_config(ball, emitters=[LAMP], spp=1))
    hidden = configured(flat_wall(ball, spp=1))
    for config in (view, hidden):
        said = bent_and_unbent(config)
        assert [text.split(":")[0] for text in said] == ["scene.hidden_geometry.0.bsdf"] * warns


@pytest.mark.parametrize(("opacity", "warns"), [("0.5", True), ("1", False)])
def test_a_mask_of_a_scene_file(tmp_path: Path, opacity: str, warns: bool) -> None:
    """The same is said of XML."""
    content = f"""<shape type='cube'><bsdf type='mask'><float name='opacity' value='{opacity}'/>
      <bsdf type='dielectric'/></bsdf></shape>"""
    scene = {"mitsuba": write_scene(tmp_path, content)}
    said = bent_and_unbent(configured(view_config(emitters=[LAMP], spp=1, scene=scene), folder=tmp_path))
    assert len(said) == warns


def bent_and_unbent(config: Config) -> list[str]:
    """What is said of light that crosses a surface in two ways, before a render."""
    _, engine, _ = stages.set_up_engine(config, stages.started_backend(config))
    from nlosrender.engine.preflight.scene_warnings import scene_warnings

    return [text for text in scene_warnings(engine) if "bent as well as unbent" in text]


COLOURED = """<shape type='sphere'><point name='center' x='9' y='0' z='0'/>
  <bsdf type='diffuse'><rgb name='reflectance' value='0.1 0.2 0.3'/></bsdf></shape>"""  # out of sight


@pytest.mark.parametrize(
    "reflectance", ["<spectrum name='reflectance' value='0.5'/>", "<float name='reflectance' value='0.5'/>"]
)
def test_a_uniform_reflectance_is_grey(tmp_path: Path, reflectance: str) -> None:
    """A number for all wavelengths has no colour in a render that has three, under a white lamp."""
    plate = f"<shape type='rectangle'><bsdf type='diffuse'>{reflectance}</bsdf></shape>"
    lamp = LAMP | {"position": [0, 0, 2]}
    steady = seen(tmp_path, plate + COLOURED, emitters=[lamp], camera=PINHOLE).steady
    # the middle is lit along its normal from 2 m: intensity / 2^2, times reflectance / pi
    np.testing.assert_allclose(steady[:, 1, 2], 0.5 / np.pi / 4, rtol=1e-4)  # the pixel's width, float32


def test_a_uniform_light_has_the_colour_of_equal_energy(tmp_path: Path) -> None:
    """Of light a number for all wavelengths is no white: sRGB's is D65. Its luminance is the number, as in grey."""
    lamp = """<shape type='rectangle'><emitter type='area'><spectrum name='radiance' value='0.5'/></emitter></shape>"""
    color = seen(tmp_path, lamp + COLOURED, emitters=[], camera=PINHOLE, max_bounces=0).steady[:, 1, 2]
    grey = seen(tmp_path, lamp, emitters=[], camera=PINHOLE, max_bounces=0).steady[:, 1, 2]
    # equal energy, XYZ = (1, 1, 1), by the matrix of IEC 61966-2-1
    np.testing.assert_allclose(
        color, 0.5 * np.array([1.2048, 0.9483, 0.9089]), rtol=2e-3
    )  # Mitsuba's colour curves are sampled
    np.testing.assert_allclose(np.dot([0.2126, 0.7152, 0.0722], color), grey, rtol=2e-3)


def test_a_metal_has_the_colours_it_has_in_yaml(tmp_path: Path) -> None:
    """A mirror of gold shows a white panel in the reflectances of Mitsuba's rgb variant, from XML and YAML alike."""
    panel = {"type": "rectangle", "width": 2, "height": 2, "center": [0, 0, 6], "normal": [0, 0, -1], "radiance": 3.0}
    options: dict[str, Any] = {"emitters": [panel], "camera": PINHOLE, "max_bounces": 1, "spp": 16}
    gold = {"type": "conductor", "material": "Au"}
    mirror = {"type": "rectangle", "width": 2, "height": 2, "center": [0, 0, 0], "normal": [0, 0, 1], "bsdf": gold}
    from_yaml = see(view_config(mirror, **options)).steady
    content = "<shape type='rectangle'><bsdf type='conductor'><string name='material' value='Au'/></bsdf></shape>"
    from_xml = seen(tmp_path, content, **options).steady
    assert from_xml.shape == from_yaml.shape == (3, 3, 5)
    np.testing.assert_allclose(from_xml, from_yaml, rtol=1e-5)  # float32, of scenes in different units
    start_backend("llvm", colored=True, polarized=False)
    import mitsuba as mi

    straight = mi.SurfaceInteraction3f()
    straight.wi = [0, 0, 1]
    _, reflectance = mi.load_dict(gold).sample(mi.BSDFContext(), straight, 0.5, [0.5, 0.5])
    # at 0.005 degrees from the normal the reflectance is the same to 1e-8
    np.testing.assert_allclose(from_xml[:, 1, 2], 3.0 * np.ravel(reflectance), rtol=1e-5)
    assert from_xml[0, 1, 2] > 1.5 * from_xml[2, 1, 2]


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ("<shape type='sphere' id='ball'><float name='radius' value='0'/></shape>", "id='ball'>: radius: got 0, need"),
        ("<shape type='cylinder'><float name='radius' value='-1'/></shape>", "radius: got -1, need"),
        ("<shape type='cylinder'><point name='p1' value='0 0 0'/></shape>", "p0 and p1 are the same point"),
        ("<shape type='cube'>{flat}<scale x='2' y='3' z='0'/>{end}</shape>", r"got \[2, 3, 0\].* none of them 0"),
        ("<shape type='disk'>{flat}<matrix value='1 0 0 1 0 0 0 0 1'/>{end}</shape>", "the matrix is singular"),
        ("<shape type='rectangle'>{flat}<scale value='1e-12'/>{end}</shape>", "2e-12 m large"),
        ("<shape type='sphere'><float name='radius' value='1e-9'/><point name='center' x='9'/></shape>", "float32"),
        ("<shape type='rectangle'>{flat}<scale value='1e-8'/><translate y='5'/>{end}</shape>", "float32 rounds"),
        ("<shape type='ply'><string name='filename' value='line.ply'/></shape>", "none of its triangles has an area"),
        (
            "<shape type='ply'><string name='filename' value='sheet.ply'/>{flat}<scale x='0'/>{end}</shape>",
            "none of them 0",
        ),
    ],
)
def test_a_shape_that_is_not_there_is_refused(shape: str, message: str, tmp_path: Path) -> None:
    """Round shapes without radius, flattened and vanishing ones, are told with their line; a sound one hides none."""
    for name, y in (("line", 0), ("sheet", 1)):
        rows = ["ply", "format ascii 1.0", "element vertex 3", *(f"property float {axis}" for axis in "xyz")]
        rows += ["element face 1", "property list uchar int vertex_indices", "end_header"]
        rows += ["0 0 0", "1 0 0", f"2 {y} 0", "3 0 1 2"]
        (tmp_path / f"{name}.ply").write_text("\n".join(rows) + "\n", encoding="utf-8")
    shape = shape.format(flat="<transform name='to_world'>", end="</transform>")
    with pytest.raises(ConfigError, match=rf"scene\.xml: line 3: .*{message}") as caught:
        seen(tmp_path, f"<shape type='cube'/>\n{shape}")
    assert caught.value.issues[0].key == "scene.mitsuba"


def test_a_mesh_that_mitsuba_reads_otherwise_is_refused(tmp_path: Path) -> None:
    """An L as one polygon: Mitsuba cuts a fan of 1.5 times its area; as triangles it is taken."""
    corners = [(0, 0.8), (0.24, 0.8), (0.24, 0.24), (0.8, 0.24), (0.8, 0), (0, 0)]
    lines = [f"v {x} {y} -1" for x, y in corners]
    shape = "<shape type='obj'><string name='filename' value='ell.obj'/></shape>"
    (tmp_path / "ell.obj").write_text("\n".join([*lines, "f 1 2 3 4 5 6"]))
    message = r"line 2: <shape type='obj'>: .*ell\.obj cannot be used as a mesh: Mitsuba reads .* of its 0\.3264 square"
    with pytest.raises(ConfigError, match=message):
        seen(tmp_path, shape)
    (tmp_path / "ell.obj").write_text("\n".join([*lines, "f 1 6 2", "f 2 6 3", "f 3 6 4", "f 4 6 5"]))
    view = seen(tmp_path, shape)
    assert view.mean.any()
    (mesh,) = view.engine.built.meshes
    assert mesh.line() == (
        "shape at line 2 (ell.obj): 4 triangles, 0.3264 m^2, 0.8 x 0.8 x 0 m, smoothed normals (up to 0 degrees "
        "from the faces'), no texture coordinates"
    )


def test_a_flat_shape_is_told_without_a_renderer(tmp_path: Path) -> None:
    """What the numbers of the file tell, ``validate`` tells."""
    write_scene(tmp_path, "<shape type='disk'><transform name='to_world'><scale value='0'/></transform></shape>")
    with pytest.raises(ConfigError, match=r"line 2: <shape type='disk'>: to_world: got \[0, 0, 0\]"):
        configured(view_config(emitters=[LAMP], scene={"mitsuba": "scene.xml"}), folder=tmp_path)


@pytest.mark.parametrize(
    "steps",
    [
        "<translate x='1' z='-2'/>",
        "<scale x='2' y='0.5'/><translate value='1, 2, 3'/><scale value='3'/>",
        "<rotate y='1' angle='30'/><rotate x='0.6' z='-0.8' angle='-70'/><rotate value='0 0 1' angle='5'/>",
        "<scale value='1, 2, 3'/><lookat origin='1, 2, 3' target='0, -1, 5' up='0, 1, 0.2'/>",
        "<matrix value='1 2 0 4  0 1 0.5 2  0.25 0 1 -1  0 0 0 1'/><translate y='1'/>",
        "<matrix value='0 -2 0  1 0 0  0 0 3'/>",
    ],
)
def test_transforms_are_those_mitsuba_reads(steps: str, tmp_path: Path) -> None:
    """The corners of a shape lie where Mitsuba puts them."""
    name = write_scene(tmp_path, f"<shape type='rectangle'><transform name='to_world'>{steps}</transform></shape>")
    root, _ = read_mitsuba_xml(tmp_path / name)
    (shape,) = root.iter("shape")
    matrix = np.eye(4)
    for step in placement(shape):
        matrix = transform_matrix(step) @ matrix
    start_backend("llvm", colored=False, polarized=False)
    import mitsuba as mi

    (theirs,) = mi.load_file(str(tmp_path / name)).shapes()
    found = np.array(mi.traverse(theirs)["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    np.testing.assert_allclose(matrix, found, atol=1e-5)  # float32, of numbers up to 12


def test_an_axis_that_would_shear_is_refused(tmp_path: Path) -> None:
    """Mitsuba's rotation about (1, 1, 0) is none: it does not scale the axis to length 1."""
    shape = "<shape type='cube'><transform name='to_world'><rotate x='1' y='1' angle='30'/></transform></shape>"
    with pytest.raises(ConfigError, match=r"line 2: <rotate> about an axis of length 1\.41421, .* 0\.707107, 0\.707"):
        seen(tmp_path, shape)


@pytest.mark.parametrize("holder", ["bumpmap", "normalmap"])
def test_a_texture_that_cannot_be_evaluated_is_told_before_the_render(holder: str, tmp_path: Path) -> None:
    """A checkerboard has no slope and no normals; Mitsuba only notices while it renders."""
    bsdf = {"type": holder, "normalmap": {"type": "checkerboard"}, "inner": {"type": "diffuse"}}
    plate = {"type": "rectangle", "width": 1, "height": 1, "center": [0, 0, 0], "normal": [0, 0, 1], "bsdf": bsdf}
    with pytest.raises(ConfigError, match="need a bitmap") as caught:
        see(view_config(plate, emitters=[LAMP], spp=1))
    assert caught.value.issues[0].key == "scene.hidden_geometry.0.bsdf"
    content = f"""<shape type='rectangle'><bsdf type='{holder}'><texture type='checkerboard' name='normalmap'/>
        <bsdf type='diffuse'/></bsdf></shape>"""
    with pytest.raises(ConfigError, match=r"Rectangle: Mitsuba cannot evaluate its BSDF: .* need a bitmap"):
        seen(tmp_path, content)
    del caught
    gc.collect()  # kernels of later tests hold every BSDF that is still alive


def test_what_mitsuba_says_is_told_with_the_line_of_the_file(tmp_path: Path) -> None:
    """Comments and what is left out before it shift nothing."""
    content = """<!-- a comment
         of three
         lines --><integrator type='path'>
      <integer name='max_depth' value='5'/>
    </integrator>
    <shape type='sphere'>
        <float name='radius' value='1'/>
        <string name='center' value='nonsense'/>
    </shape>"""
    with pytest.raises(ConfigError, match=r"center") as caught:
        seen(tmp_path, content)
    assert "[parser" not in str(caught.value)
    assert "line 7" in str(caught.value), caught.value


def test_parameters_that_a_plugin_does_not_have_are_left_out_with_a_warning(tmp_path: Path) -> None:
    """Exporters write some that only their own version reads; the rest of the scene is what it is without them."""
    content = """<shape type='sphere'><float name='radius' value='1'/>{}
    <bsdf type='diffuse'>{}</bsdf></shape>"""
    unknown = "<float name='nonsense' value='1'/>", "\n<boolean name='odd' value='true'/>"
    with_them, without = (seen(tmp_path, content.format(*each)) for each in (unknown, ("", "")))
    np.testing.assert_array_equal(with_them.mean, without.mean)
    assert without.engine.built.warnings == ()
    first, second = sorted(with_them.engine.built.warnings)
    assert "line 2: <shape type='sphere'> has no parameter nonsense, which is left out" in first + second
    assert "line 3: <bsdf type='diffuse'> has no parameter odd, which is left out" in first + second


def test_a_mesh_in_mitsubas_own_format(tmp_path: Path) -> None:
    """A .serialized file is read in XML, too; one with an index that refers to nothing is refused with its line."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], dtype=np.float32)

    def write(last: int) -> None:
        body = struct.pack("<I", 0x1000) + b"mesh\0" + struct.pack("<QQ", 3, 1) + corners.tobytes()
        body += np.array([0, 1, last], dtype=np.uint32).tobytes()
        data = struct.pack("<HH", 0x041C, 4) + zlib.compress(body) + struct.pack("<QI", 0, 1)
        (tmp_path / "mesh.serialized").write_bytes(data)

    content = "<shape type='serialized'><string name='filename' value='mesh.serialized'/></shape>"
    write(2)
    assert seen(tmp_path, content).engine.built.n_triangles == 1
    write(9)
    with pytest.raises(ConfigError, match=r"line 2: <shape type='serialized'>: .* refers to vertex 9"):
        seen(tmp_path, content)


def test_the_backs_of_mirroring_transforms_are_kept(tmp_path: Path) -> None:
    """Scales below zero turn a shape round and are allowed: only a flat one is not."""
    view = seen(tmp_path, "<shape type='cube'><transform name='to_world'><scale value='-1'/></transform></shape>")
    assert view.engine.built.hidden_bounds is not None


@pytest.mark.parametrize(
    ("bsdf", "message"),
    [
        ("<bsdf type='dielectric'><float name='int_ior' value='0'/></bsdf>", "int_ior: got 0, need a number > 0"),
        ("<bsdf type='dielectric'><string name='int_ior' value='watr'/></bsdf>", "Did you mean water"),
        ("<bsdf type='conductor'><string name='material' value='../Au'/></bsdf>", "material: got '../Au'"),
        ("<bsdf type='principled' id='m'><float name='specular' value='2'/></bsdf>", "id='m'>: specular: got 2"),
        ("<bsdf type='principled'><rgb name='base_color' value='2, 0, 0'/></bsdf>", r"base_color: got \[2, 0, 0\]"),
        (
            "<bsdf type='twosided'>\n<bsdf type='mask'><float name='opacity' value='-1'/><bsdf type='diffuse'/></bsdf>"
            "</bsdf>",
            "line 3: <bsdf type='mask'>: opacity: got -1",
        ),
    ],
)
def test_materials_have_the_bounds_they_have_in_yaml(bsdf: str, message: str, tmp_path: Path) -> None:
    """A number that YAML refuses is refused in XML, told with its line, and before anything is rendered."""
    write_scene(tmp_path, f"<shape type='sphere'>{bsdf}</shape>")
    with pytest.raises(ConfigError, match=message):
        configured(view_config(emitters=[LAMP], scene={"mitsuba": "scene.xml"}), folder=tmp_path)


def test_the_metals_and_media_that_are_known_are_those_mitsuba_has() -> None:
    """Each loads; and so does hair, some of whose parameters cannot be read."""
    start_backend("llvm", colored=True, polarized=False)
    import mitsuba as mi

    from nlosrender.scene.loading.materials import load_bsdf

    data = Path(mi.__file__).parent / "data" / "ior"
    assert set(METALS) == {file.name.split(".")[0] for file in data.glob("*.spd")}
    for medium in MEDIA:
        load_bsdf({"type": "dielectric", "int_ior": medium.upper(), "ext_ior": 1.7}, "bsdf")
    load_bsdf({"type": "hair"}, "bsdf")
