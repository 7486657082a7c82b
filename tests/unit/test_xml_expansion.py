"""Parameters, included files, folders, aliases and old names in Mitsuba scenes: the scene is the one without them."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import pytest

from nlosrender.config.mitsuba_xml import named_files, read_mitsuba_xml
from nlosrender.files.identity import capture_hash

PLAIN = """<scene version='3.0.0'>
  <bsdf type='diffuse' id='red'><rgb name='reflectance' value='0.5, 0, 0'/></bsdf>
  <shape type='sphere'>
    <float name='radius' value='2'/>
    <transform name='to_world'><translate x='1'/><lookat origin='0 0 4' target='0 0 0' up='0 1 0'/></transform>
    <ref id='red'/>
  </shape>
</scene>"""


def written(folder: Path, content: str, name: str = "scene.xml") -> Path:
    """Write a file and return its path."""
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(content, encoding="utf-8")
    return path


def told(element: Element) -> tuple:
    """Everything about an element and what is in it."""
    return element.tag, dict(element.attrib), [told(child) for child in element]


def read(folder: Path, content: str) -> tuple:
    """Everything that is left of a scene."""
    return told(read_mitsuba_xml(written(folder, content))[0])


def test_a_scene_with_everything_is_the_scene_without(tmp_path: Path) -> None:
    """Parameters, an included file and an alias in one scene, and names as version 0.6 writes them."""
    plain = read(tmp_path, PLAIN)
    written(
        tmp_path,
        "<bsdf version='0.6.0' type='diffuse' id='base'><rgb name='diffuseReflectance' value='$r, 0, 0'/></bsdf>",
        "parts/material.xml",
    )
    content = """<scene version='0.5.0'>
      <default name='r' value='0.5'/> <default name='r' value='0.9'/> <default name='radius' value='2'/>
      <path value='parts'/>
      <include filename='material.xml'/>
      <alias id='base' as='red'/>
      <integrator type='volpath'><integer name='maxDepth' value='$depth'/></integrator>
      <shape type='sphere'>
        <float name='radius' value='${radius}'/>
        <transform name='toWorld'><translate x='1'/><lookAt origin='0 0 4' target='0 0 0' up='0 1 0'/></transform>
        <ref id='red'/>
      </shape>
    </scene>"""
    found = read(tmp_path, content)
    assert str(found).replace("'base'", "'red'") == str(plain)


def test_parameters_hold_from_their_place_on(tmp_path: Path) -> None:
    """An included file has those of its parent, and what it sets itself holds after it; longer names come first."""
    written(
        tmp_path,
        "<scene version='3.0.0'><default name='a' value='9'/><default name='ab' value='3'/></scene>",
        "other.xml",
    )
    content = """<scene version='3.0.0'><default name='a' value='1'/><include filename='other.xml'/>
      <shape type='sphere'><float name='radius' value='$a'/><point name='center' x='$ab' y='0' z='0'/>
      <string name='id' value='\\$a'/></shape></scene>"""
    (_, _, (shape,)) = read(tmp_path, content)
    assert [child[1] for child in shape[2]] == [
        {"name": "radius", "value": "1"},
        {"name": "center", "x": "3", "y": "0", "z": "0"},
        {"name": "id", "value": "$a"},
    ]


@pytest.mark.parametrize("content", ["<scene version='3.0.0'/>", "<shape version='3.0.0' type='sphere'/>"])
def test_an_included_file_belongs_to_the_capture(content: str, tmp_path: Path) -> None:
    """A render does not go on with another included file than it began with."""
    included = written(tmp_path, content, "other.xml")
    scene = written(tmp_path, "<scene version='3.0.0'><include filename='other.xml'/></scene>")
    root, _ = read_mitsuba_xml(scene)
    assert list(named_files(root)) == [included]
    before = capture_hash({"scene": {"mitsuba": str(scene)}})
    included.write_text(content + "<!-- changed -->", encoding="utf-8")
    assert capture_hash({"scene": {"mitsuba": str(scene)}}) != before


def test_files_are_found_in_the_folders_of_paths(tmp_path: Path) -> None:
    """Both those beside the scene and those in a <path>; the nearest <path> first."""
    content = """<scene version='3.0.0'><path value='one'/><path value='two'/>
      <shape type='ply'><string name='filename' value='mesh.ply'/></shape>
      <shape type='ply'><string name='filename' value='here.ply'/></shape></scene>"""
    for name in ("one/mesh.ply", "two/mesh.ply", "here.ply"):
        written(tmp_path, "ply", name)
    root, _ = read_mitsuba_xml(written(tmp_path, content))
    assert list(named_files(root)) == [tmp_path / "two" / "mesh.ply", tmp_path / "here.ply"]


def test_a_texture_of_version_0_6_is_scaled_as_mitsuba_scales_it(tmp_path: Path) -> None:
    """uoffset and uscale become a transform that moves first."""
    content = """<scene version='0.6.0'><bsdf type='diffuse'><texture type='checkerboard' name='reflectance'>
      <float name='uscale' value='4'/><float name='voffset' value='0.5'/></texture></bsdf></scene>"""
    (_, _, ((_, _, ((_, _, (transform,)),)),)) = read(tmp_path, content)
    steps = [("translate", {"x": "0", "y": "0.5"}, []), ("scale", {"x": "4", "y": "1"}, [])]
    assert transform == ("transform", {"name": "to_uv"}, steps)


def test_only_a_sensor_that_can_be_used_is_kept(tmp_path: Path) -> None:
    """Others, also in shapes, and what they lie in are left out; no value is needed for what nobody reads."""
    film = "<film type='hdrfilm'><integer name='width' value='{}'/><integer name='height' value='3'/></film>"
    content = f"""<scene version='3.0.0'>
      <sensor type='thinlens'/>
      <sensor type='perspective'>{film.format("$width")}</sensor>
      <sensor type='perspective'>{film.format(5)}<sampler type='x'><integer name='n' value='$n'/></sampler>
        <ref id='fog'/></sensor>
      <shape type='sphere'><sensor type='irradiancemeter'/></shape></scene>"""
    root, size = read_mitsuba_xml(written(tmp_path, content))
    assert size == (5, 3)
    assert [child.tag for child in root] == ["sensor", "shape"]
    assert [child.tag for child in root[0]] == ["film"]
    assert not list(root[1])


def test_true_may_be_written_with_a_capital(tmp_path: Path) -> None:
    """Mitsuba takes it, too."""
    content = "<scene version='3.0.0'><shape type='sphere'><boolean name='flip_normals' value='True'/></shape></scene>"
    assert read(tmp_path, content)[2][0][2][0][1]["value"] == "true"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<scene><shape type='$kind'/></scene>", r"\$kind has no <default>; write <default name='kind' value='...'/>"),
        ("<scene><path value='nowhere'/></scene>", r"line 1: <path>: there is no folder .*nowhere"),
        ("<scene><path/></scene>", "<path> has no value"),
        ("<scene><alias as='a'/></scene>", "<alias> has no id"),
        ("<scene version='new'/>", "its version is 'new' .*need one such as 3.0.0"),
        ("<scene><include filename='scene.xml'/></scene>", "include each other more than 15 deep"),
        ("<scene>\n<include filename='bad.xml'/></scene>", r"bad.xml, line 1: it is not well-formed XML"),
        ("<scene>\n<include filename='odd.xml'/></scene>", r"odd.xml, line 2: <phase> is not supported"),
        ("<scene><shape type='Sphere'/></scene>", "Did you mean sphere"),
        ("<scene><shape type='instance'/></scene>", "write each of the shapes out"),
    ],
)
def test_mistakes(content: str, message: str, tmp_path: Path) -> None:
    """They are told with the line, and the file where that is an included one."""
    written(tmp_path, "<scene", "bad.xml")
    written(tmp_path, "<scene>\n<phase type='hg'/></scene>", "odd.xml")
    with pytest.raises(ValueError, match=message):
        read_mitsuba_xml(written(tmp_path, content))


@pytest.mark.parametrize(
    ("times", "message"),
    [(20, "includes more than 1000 files"), (2, "more than 100000 elements, with those of the files it includes")],
)
def test_files_that_include_others_many_times_are_refused(times: int, message: str, tmp_path: Path) -> None:
    """A few short files could ask for more than there is memory: 20 x 20 x 20 files, or 2 x 2 x 2 large ones."""
    for depth in range(3):
        include = f"<include filename='{depth + 1}.xml'/>"
        written(tmp_path, f"<scene>{include * times}</scene>", f"{depth}.xml")
    written(tmp_path, f"<scene>{'<bsdf/>' * (100_000 // 4 if times == 2 else 1)}</scene>", "3.xml")
    with pytest.raises(ValueError, match=message):
        read_mitsuba_xml(tmp_path / "0.xml")


def test_included_elements_lie_no_deeper_than_others(tmp_path: Path) -> None:
    """10 files of 10 elements in each other are too deep, wherever the files begin."""
    content = "<bsdf type='twosided'>" * 10 + "{}" + "</bsdf>" * 10
    for depth in range(10):
        written(tmp_path, content.format(f"<include filename='{depth + 1}.xml'/>"), f"{depth}.xml")
    written(tmp_path, content.format(""), "10.xml")
    with pytest.raises(ValueError, match="more than 64 deep"):
        read_mitsuba_xml(written(tmp_path, "<scene><include filename='0.xml'/></scene>"))
