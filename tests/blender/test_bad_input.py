# SPDX-License-Identifier: GPL-3.0-or-later
"""Bad and extreme input through the commands: each ends in one line and unharmed files, or in physically sane light.

Bakes run in this process (`_Here`), which spares a second of start-up each and lets a defect in a stage fail the test
with its own traceback; the tests of signals and streams at the end start the real programs.
"""

from __future__ import annotations

import hashlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
TOOL = ROOT / "tools" / "prt.py"
FAST = ["--preset", "draft", "--set", "directions=64", "--set", "gather_directions=64", "--set", "error_receivers=0",
        "--set", "spacing=0.25"]
CUBE = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
INWARD = [face[::-1] for face in FACES]
NAN = float("nan")
# Sampling noise of so few rays; a white unit environment can light nothing beyond 1.
NOISE = 0.12

if "prt" not in sys.modules:  # the checkout as a package, as tools/prt.py loads it, without registering anything
    sys.modules["prt"] = types.ModuleType("prt")
    sys.modules["prt"].__path__ = [str(ROOT)]

Build = Callable[[], object]


class _Here:
    """BakeProcess without the process."""

    def __init__(self, _command: list[str], job: Path) -> None:
        self.job = job

    def start(self) -> None:
        """Nothing to start."""

    def cancel(self) -> None:
        """Nothing to stop."""

    def wait(self, _interval: float = 0.0) -> Iterator[dict]:
        from prt.prt_addon.baking.job import run_job
        from prt.prt_addon.baking.process import error_message
        from prt.prt_addon.errors import PRTError

        try:
            list(run_job(self.job))
        except PRTError as error:
            yield error_message(error)
            return
        yield {"type": "done"}


@pytest.fixture(autouse=True)
def jobs(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of jobs, of this test alone."""
    from prt.operators import bake_session

    folder = tmp_path_factory.mktemp("jobs")
    monkeypatch.setattr(bake_session, "BakeProcess", _Here)
    monkeypatch.setattr(bake_session, "jobs_folder", lambda: folder)
    return folder


@dataclass(frozen=True)
class Outcome:
    """code: of the exit; lines: what was said beside progress, warnings and the error; all: everything on stderr."""

    code: int
    lines: list[str]
    all: str


@pytest.fixture
def prt(capfd: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """Run a command in this process; any exception but SystemExit of `main` fails the test."""
    from prt.operators.commands import main
    from prt.operators.job_mixin import STAGES

    def run(*arguments: object) -> Outcome:
        capfd.readouterr()
        code = main([str(a) for a in arguments])
        text = capfd.readouterr().err
        # Beside what a bake says about its progress and its error, which is no complaint.
        aside = tuple(f"prt: {name}" for name in (*STAGES.values(), "warning", "Total error", "The error was"))
        lines = [line for line in text.splitlines() if line.startswith("prt: ") and not line.startswith(aside)]
        assert "Traceback" not in text
        return Outcome(code, lines, text)

    return run


def new_scene(world: float | None = 1.0) -> None:
    """An empty scene under a uniform sky."""
    bpy.ops.wm.read_homefile(use_empty=True)
    if world is not None:
        bpy.context.scene.world = bpy.data.worlds.new("Sky")
        background().inputs["Color"].default_value = (world, world, world, 1.0)


def background() -> bpy.types.Node:
    return bpy.context.scene.world.node_tree.nodes["Background"]


def add(name: str, vertices: object, faces: object) -> bpy.types.Object:
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([tuple(map(float, v)) for v in vertices], [], [tuple(f) for f in faces])
    found = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(found)
    return found


def cube(name: str = "Cube", size: float = 1.0, x: float = 0.0) -> bpy.types.Object:
    return add(name, np.array(CUBE) * size + (x, 0, 0), FACES)


def floor(size: float = 3.0, z: float = -1.5) -> bpy.types.Object:
    return add("Floor", [(-size, -size, z), (size, -size, z), (size, size, z), (-size, size, z)], [(0, 1, 2, 3)])


def paint(found: bpy.types.Object, *colour: float) -> bpy.types.Object:
    material = bpy.data.materials.new("Paint")
    material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (*colour, 1.0)
    found.data.materials.append(material)
    return found


def saved(path: Path) -> Path:
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


def hidden(folder: Path) -> list[str]:
    """Temporary files left in a folder."""
    return [p.name for p in folder.iterdir() if p.name.startswith(".") or p.name.endswith(("@", ".part"))]


# ---- Input that can't be baked ---------------------------------------------------------------------------------------

def _hide() -> None:
    cube("Hidden").hide_render = True
    floor()


def _lamp() -> None:
    floor()
    bpy.ops.object.light_add(type="POINT")
    bpy.context.object.name = "Lamp"
    bpy.ops.object.empty_add()
    bpy.context.object.name = "Nothing"


def _sky_image(path: str | None) -> None:
    cube()
    tree = bpy.context.scene.world.node_tree
    node = tree.nodes.new("ShaderNodeTexEnvironment")
    tree.links.new(node.outputs[0], background().inputs["Color"])
    if path is not None:
        node.image = bpy.data.images.new("sky", 8, 4, float_buffer=True)
        node.image.source, node.image.filepath = "FILE", path


def _strength(value: float) -> None:
    cube()
    background().inputs["Strength"].default_value = value


def _sun(value: float) -> None:
    cube()
    bpy.ops.object.light_add(type="SUN")
    bpy.context.object.name, bpy.context.object.data.energy = "Sun", value


def _curve(bevel: float) -> bpy.types.Object:
    bpy.ops.curve.primitive_bezier_circle_add()
    bpy.context.object.name = "Curve"
    bpy.context.object.data.bevel_depth, bpy.context.object.data.resolution_u = bevel, 3
    return bpy.context.object


def _set(owner: object, name: str, value: object) -> None:
    setattr(owner, name, value)


def _linked() -> None:
    path = Path(bpy.app.tempdir) / "library.blend"
    cube("Linked")
    bpy.data.libraries.write(str(path), {bpy.data.objects["Linked"]})
    new_scene()
    with bpy.data.libraries.load(str(path), link=True) as (_, wanted):
        wanted.objects = ["Linked"]
    bpy.context.scene.collection.objects.link(wanted.objects[0])


BAD: dict[str, tuple[Build, list[str], str]] = {
    "empty scene": (lambda: None, [], "scene: "),
    "empty mesh": (lambda: add("E", [], []), [], "E: "),
    "no faces": (lambda: add("E", [(0, 0, 0), (1, 0, 0)], []), [], "E: "),
    "1e5 loose vertices": (lambda: add("Loose", np.zeros((100_000, 3)), []), [], "Loose: the mesh has no faces"),
    "NaN coordinates": (lambda: _set(cube().data.vertices[3].co, "x", NAN), [], "Cube: 1 vertices"),
    "infinite coordinates": (lambda: _set(cube().data.vertices[3].co, "x", float("inf")), [], "Cube: 1 vertices"),
    "NaN location": (lambda: _set(cube(), "location", (NAN, 0, 0)), [], "Cube: 8 vertices"),
    "NaN in a bystander": (lambda: (floor(), _set(cube(), "location", (NAN, 0, 0))), ["--objects", "Floor"], "Cube: "),
    "all faces without area": (lambda: add("Z", [(0, 0, 0), (1, 1, 1), (2, 2, 2)], [(0, 1, 2)]), [], "Z: all faces"),
    "all in one point": (lambda: add("P", [(1, 1, 1)] * 8, FACES), [], "P: "),
    "scale zero": (lambda: _set(cube(), "scale", (0, 0, 0)), [], "Cube: its scale is zero"),
    "scale zero on one axis": (lambda: _set(cube(), "scale", (1, 1, 0)), [], "Cube: its scale is zero"),
    "hidden target": (_hide, ["--objects", "Hidden"], "Hidden: it is hidden"),
    "everything hidden": (lambda: _set(cube(), "hide_render", True), [], "scene: no object is visible"),
    "unknown name": (cube, ["--objects", "Cube,Cubo"], "Cubo: "),
    "a light as target": (_lamp, ["--objects", "Lamp"], "Lamp: it has no mesh"),
    "an empty as target": (_lamp, ["--objects", "Floor,Nothing"], "Nothing: it has no mesh"),
    "a curve without faces": (lambda: (floor(), _curve(0.0)), ["--objects", "Curve"], "Curve: it has no mesh"),
    "linked object": (_linked, [], "Linked: it is linked"),
    "NaN albedo": (lambda: paint(cube(), NAN, 0.5, 0.5), [], "Cube: the colour of 12 triangles is not a number"),
    "missing HDRI": (lambda: _sky_image("/absent/sky.exr"), [], "/absent/sky.exr: "),
    "HDRI that is no image": (lambda: _sky_image(str(TOOL)), [], "prt.py: "),
    "HDRI node without image": (lambda: _sky_image(None), [], "World Sky: "),
    "NaN sky": (lambda: _strength(NAN), [], "World Sky: "),
    "infinite sky": (lambda: _strength(float("inf")), [], "World Sky: "),
    "NaN Sun": (lambda: _sun(NAN), [], "Sun: "),
    "too fine a spacing": (cube, ["--set", "spacing=1e-6"], "Cube: the spacing asks for more"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_baked_is_named_in_one_line(case: str, prt: Callable[..., Outcome], tmp_path: Path,
                                                   monkeypatch: pytest.MonkeyPatch) -> None:
    build, arguments, words = BAD[case]
    monkeypatch.setattr("prt.prt_addon.scene.refinement.MOST_POINTS", 100_000)
    new_scene()
    build()
    source, output = saved(tmp_path / "in.blend"), tmp_path / "out.blend"
    output.write_bytes(b"a previous result")
    before = hashlib.sha256(source.read_bytes()).digest(), sorted(tmp_path.iterdir())
    found = prt("bake", "--input", source, "--output", output, "--report", tmp_path / "r.json", *FAST, *arguments)
    assert found.code == 1 and len(found.lines) == 1 and words in found.lines[0], found
    assert found.lines[0].count(". ") >= 1  # cause, then remedy
    assert (hashlib.sha256(source.read_bytes()).digest(), sorted(tmp_path.iterdir())) == before
    assert output.read_bytes() == b"a previous result"


# ---- Extreme input that has to work ----------------------------------------------------------------------------------

def _scaled(factor: float) -> None:
    for found in (cube(), floor()):
        found.scale = (factor,) * 3


def _shared_mesh() -> None:
    twin = bpy.data.objects.new("Twin", cube().data)
    twin.location.x = 3.0
    bpy.context.scene.collection.objects.link(twin)


def _emission() -> None:
    for found in (cube(), floor()):
        tree = paint(found, 1, 1, 1).data.materials[0].node_tree
        node = tree.nodes.new("ShaderNodeEmission")
        tree.links.new(node.outputs[0], tree.nodes["Material Output"].inputs["Surface"])


def _dense() -> None:
    random, vertices, faces = np.random.default_rng(1), [], []
    for number in range(60):
        vertices += list(np.array(CUBE) * 0.5 + 0.05 * random.random(3))
        faces += [tuple(8 * number + k for k in face) for face in FACES]
    add("Dense", vertices, faces)


def _bad_normals(value: float) -> None:
    attribute = cube().data.attributes.new("custom_normal", "FLOAT_VECTOR", "CORNER")
    attribute.data.foreach_set("vector", np.full(72, value, np.float32))


def _edited() -> None:
    bpy.context.view_layer.objects.active = cube()
    bpy.ops.object.mode_set(mode="EDIT")


def _names_taken() -> None:
    cube().data.attributes.new("prt_cluster", "FLOAT", "POINT")
    bpy.data.meshes["Cube"].attributes.new("prt_weights_0", "FLOAT2", "FACE")


def _text() -> None:
    bpy.ops.object.text_add()
    bpy.context.object.name, bpy.context.object.data.body = "Text", "L"
    bpy.context.object.data.extrude = 0.1


def _room(albedo: float) -> None:
    paint(add("Room", CUBE, INWARD[:5]), *(albedo,) * 3)
    paint(cube("Inside", 0.3), *(albedo,) * 3)


@dataclass(frozen=True)
class Sane:
    """What comes out under a white unit sky. mean: of unit-albedo radiance over the object's (or all) receivers."""

    build: Build
    mean: tuple[float, float] = (0.5, 1.01)
    objects: set[str] | None = None
    arguments: tuple[str, ...] = ()
    warns: str = ""


OPEN_CUBE = (0.999, 1.001)  # a lone cube sees the sky everywhere
# The cube above its floor: alike at every scale, mirrored or not.
ABOVE_FLOOR = (0.85, 0.95)

SANE: dict[str, Sane] = {
    "zero-area faces": Sane(lambda: add("Z", [*CUBE, (0, 0, 5), (0, 0, 5), (1, 0, 5)], [*FACES, (8, 9, 10)]),
                            warns="dropped 1 zero-area"),
    "a mesh without faces beside": Sane(lambda: (cube(), add("Dots", CUBE, [])), OPEN_CUBE, {"Cube"},
                                        warns="Dots: the mesh has no faces"),
    "duplicate faces": Sane(lambda: add("D", CUBE, FACES + FACES), OPEN_CUBE, warns="12 duplicate"),
    "non-manifold": Sane(lambda: add("N", [(0, 0, 0), (0, 0, 1), (1, 0, 0), (-1, 1, 0), (-1, -1, 0)],
                                     [(0, 1, 2), (0, 1, 3), (0, 1, 4)])),
    "flipped, closed": Sane(lambda: add("F", CUBE, INWARD), OPEN_CUBE, warns="all faces point inwards"),
    "flipped, open": Sane(lambda: add("F", CUBE, INWARD[:5]), (0.3, 0.8)),
    "half flipped": Sane(lambda: add("F", CUBE, FACES[:3] + INWARD[3:]), (0.2, 0.8)),
    "loose vertices": Sane(lambda: add("L", [*CUBE, *np.random.default_rng(1).random((9, 3)) * 5], FACES), (0.9, 1.0)),
    "loose vertices, unrefined": Sane(lambda: add("L", [*CUBE, (5, 5, 5)], FACES), (0.9, 1.0),
                                      arguments=("--set", "spacing=0")),
    "coordinates 1e-6": Sane(lambda: (cube(size=1e-6), floor(3e-6, -1.5e-6)), ABOVE_FLOOR),
    "coordinates 1e6": Sane(lambda: (cube(size=1e6), floor(3e6, -1.5e6)), ABOVE_FLOOR),
    "object scale 1e-6": Sane(lambda: _scaled(1e-6), ABOVE_FLOOR),
    "object scale 1e6": Sane(lambda: _scaled(1e6), ABOVE_FLOOR),
    "negative scale": Sane(lambda: _scaled(-1.0), ABOVE_FLOOR),
    "one negative scale": Sane(lambda: (_set(cube(), "scale", (-1, 1, 1)), floor()), ABOVE_FLOOR),
    "1000 km from the origin": Sane(lambda: _set(cube(), "location", (1e6, 1e6, 1e6)), OPEN_CUBE),
    "a micrometre on a plain of 1000 km": Sane(lambda: (cube(size=1e-6), floor(1e6, -1e-5)), (0.96, 0.975)),
    "a cube on a plain to the horizon": Sane(lambda: (cube(), floor(1e5)), objects={"Cube"},
                                             arguments=("--objects", "Cube"), mean=(0.8, 0.95)),
    "one triangle": Sane(lambda: add("T", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)]), OPEN_CUBE),
    "shared mesh": Sane(_shared_mesh, (0.9, 1.0), {"Cube", "Twin"}),
    "albedo 5": Sane(lambda: paint(cube(), 5, 5, 5), OPEN_CUBE),
    "albedo -1": Sane(lambda: paint(cube(), -1, 0.5, 0.5), OPEN_CUBE),
    "emission only": Sane(_emission, (0.0, 0.0)),
    "room of albedo 0.99": Sane(lambda: _room(0.99), (0.85, 1.03)),
    "dense overlapping": Sane(_dense, (0.0, 0.6), arguments=("--set", "spacing=0")),
    "a curve": Sane(lambda: _curve(0.2), arguments=("--objects", "Curve"), mean=(0.9, 1.02)),
    "a text": Sane(_text, arguments=("--objects", "Text"), mean=(0.7, 1.02)),
    "NaN custom normals": Sane(lambda: _bad_normals(NAN), OPEN_CUBE),
    "zero custom normals": Sane(lambda: _bad_normals(0.0), (0.5, 1.0)),
    "saved in edit mode": Sane(_edited, OPEN_CUBE),
    "attribute names taken": Sane(_names_taken, OPEN_CUBE, arguments=("--set", "spacing=0")),
    "comma and line break in a name": Sane(lambda: cube("a\nb, c"), OPEN_CUBE),
    "longest name": Sane(lambda: cube("Ä" * 127), OPEN_CUBE),
    "a target named twice": Sane(cube, OPEN_CUBE, {"Cube"}, ("--objects", "Cube,Cube")),
}


@pytest.mark.parametrize("case", SANE)
def test_extreme_input_gives_possible_light(case: str, prt: Callable[..., Outcome], tmp_path: Path,
                                            jobs: Path) -> None:
    """No receiver gets more than the white sky holds, none less than nothing, and the mean is what geometry says."""
    expected = SANE[case]
    new_scene()
    expected.build()
    source, output, report = saved(tmp_path / "in.blend"), tmp_path / "out.blend", tmp_path / "r.json"
    before = source.read_bytes()
    found = prt("bake", "--input", source, "--output", output, "--report", report, *FAST, *expected.arguments)
    assert found.code == 0 and not found.lines, found
    assert source.read_bytes() == before and not hidden(tmp_path) and not list(jobs.iterdir())
    assert expected.warns in " ".join(json.loads(report.read_text())["scene"]["warnings"])
    found = prt("relight", "--input", output, "--output", tmp_path / "c.npz")
    assert found.code == 0 and not found.lines, found
    with np.load(tmp_path / "c.npz", allow_pickle=False) as arrays:
        radiance, albedo, names = arrays["radiance"], arrays["albedo"], set(arrays["object"])
    assert np.isfinite(radiance).all() and radiance.min() >= -0.02
    assert albedo.min() >= 0.0 and albedo.max() <= 1.0
    lit = albedo > 0.0
    unit = radiance[lit] / albedo[lit] if lit.any() else radiance[:1] * 0.0
    assert unit.max() <= 1.0 + NOISE
    assert expected.mean[0] - 1e-6 <= unit.mean() <= expected.mean[1] + 1e-6
    assert expected.objects is None or names == expected.objects


@pytest.mark.parametrize("world", [None, 0.0], ids=["no world", "black world"])
def test_without_light_it_bakes_and_says_that_all_is_dark(world: float | None, prt: Callable[..., Outcome],
                                                          tmp_path: Path) -> None:
    new_scene(world)
    cube()
    source = saved(tmp_path / "in.blend")
    assert prt("bake", "--input", source, "--output", tmp_path / "out.blend", *FAST).code == 0
    found = prt("relight", "--input", tmp_path / "out.blend", "--output", tmp_path / "c.npz")
    assert found.code == 0 and "gives no light" in found.all
    assert not np.load(tmp_path / "c.npz")["radiance"].any()


def test_refinement_follows_the_distance_from_the_targets() -> None:
    """A plain of 200 km under a cube takes some ten thousand points, fine near the cube, and without a T-junction."""
    from prt.prt_addon.scene.refinement import EdgeLimit, refine

    corners = np.array([(-1e5, -1e5, 0), (1e5, -1e5, 0), (1e5, 1e5, 0), (-1e5, 1e5, 0)], float)
    box = np.array([(-1, -1, 0), (1, 1, 2)], float)
    limit = EdgeLimit(0.25, *box)
    points, _, _, triangles = refine(corners, np.tile((0.0, 0, 1), (4, 1)), np.ones((4, 3)),
                                     np.array([(0, 1, 2), (0, 2, 3)], np.int32), limit, "Plain")
    assert len(points) < 60_000
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    assert np.unique(edges, axis=0, return_counts=True)[1].max() == 2
    length = np.sqrt(np.sum((points[edges[:, 0]] - points[edges[:, 1]]) ** 2, axis=1))
    nearest = np.minimum(*(np.abs(points[edges[:, k], :2]).max(axis=1) for k in (0, 1)))
    assert length[nearest < 1.0].max() <= 0.25 and length.max() > 1e3


# ---- Baked data ------------------------------------------------------------------------------------------------------

@pytest.fixture(scope="module")
def baked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cube above a floor with a camera, baked."""
    from prt.operators import bake_session
    from prt.operators.commands import main

    folder = tmp_path_factory.mktemp("baked")
    new_scene()
    cube()
    floor()
    bpy.ops.object.camera_add(location=(0, -8, 4), rotation=(1.15, 0, 0))
    bpy.context.scene.camera = bpy.context.object
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bake_session, "BakeProcess", _Here)
        patch.setattr(bake_session, "jobs_folder", lambda: folder / "jobs")
        output = folder / "baked.blend"
        assert main(["bake", "--input", str(saved(folder / "in.blend")), "--output", str(output), *FAST]) == 0
    return output


def carrier() -> bpy.types.Mesh:
    """The mesh that carries the cube's bake."""
    return bpy.data.objects["Cube"]["prt_receiver"]


def _header(**changes: object) -> Build:
    def change() -> None:
        carrier()["prt_header"] = json.dumps({**json.loads(carrier()["prt_header"]), **changes})
    return change


def _property(name: str, value: object) -> Build:
    def change() -> None:
        del carrier()[name]
        if value is not None:
            carrier()[name] = value
    return change


def _attribute(name: str, kind: str | None, domain: str = "POINT") -> Build:
    def change() -> None:
        carrier().attributes.remove(carrier().attributes[name])
        if kind:
            carrier().attributes.new(name, kind, domain)
    return change


def _fill(name: str, member: str, value: float) -> Build:
    def change() -> None:
        data = carrier().attributes[name].data
        width = {"value": 1, "vector": 3 if name == "prt_normal" else 4, "color": 4}[member]
        kind = np.int32 if name == "prt_cluster" else np.float32
        data.foreach_set(member, np.full(len(data) * width, value, kind))
    return change


def _nan_bases() -> None:
    carrier()["prt_bases"] = np.full(len(carrier()["prt_bases"]), NAN, np.float32)


BROKEN: dict[str, tuple[Build, str]] = {
    "weights deleted": (_attribute("prt_weights_0", None), "prt_weights_0"),
    "cluster deleted": (_attribute("prt_cluster", None), "prt_cluster"),
    "cluster as float": (_attribute("prt_cluster", "FLOAT"), "prt_cluster"),
    "cluster as vector": (_attribute("prt_cluster", "FLOAT_VECTOR"), "prt_cluster"),
    "cluster as text": (_attribute("prt_cluster", "STRING"), "prt_cluster"),
    "weights as vector": (_attribute("prt_weights_0", "FLOAT_VECTOR"), "prt_weights_0"),
    "weights on corners": (_attribute("prt_weights_0", "FLOAT_COLOR", "CORNER"), "prt_weights_0"),
    "albedo as integer": (_attribute("prt_albedo", "INT"), "prt_albedo"),
    "normals as integer": (_attribute("prt_normal", "INT"), "prt_normal"),
    "cluster out of range": (_fill("prt_cluster", "value", 10 ** 6), "cluster index"),
    "cluster negative": (_fill("prt_cluster", "value", -1), "cluster index"),
    "NaN weights": (_fill("prt_weights_0", "vector", NAN), "not finite"),
    "NaN albedo": (_fill("prt_albedo", "color", NAN), "not finite"),
    "NaN normals": (_fill("prt_normal", "vector", NAN), "not finite"),
    "NaN bases": (_nan_bases, "not finite"),
    "bases deleted": (_property("prt_bases", None), "no bases"),
    "bases short": (_property("prt_bases", np.zeros(5, np.float32)), "5 numbers"),
    "bases a text": (_property("prt_bases", "abc"), "bases"),
    "bases a group": (_property("prt_bases", {"a": 1}), "bases"),
    "header a number": (_property("prt_header", 5), "header"),
    "header a list": (_property("prt_header", "[]"), "header"),
    "header cut off": (_property("prt_header", '{"schema": 1'), "header"),
    "schema newer": (_header(schema=99), "schema 99"),
    "schema no number": (_header(schema="1"), "header"),
    "shape missing": (_header(shape=None), "shape"),
    "shape huge": (_header(shape=[10 ** 18, 10 ** 18, 1, 10 ** 18, 10 ** 18]), "prt_weights"),
    "shape negative": (_header(shape=[-1, -1, 1, 16, 1]), "shape"),
    "shape no square of an order": (_header(shape=[1, 4, 1, 8, 3]), "shape"),
    "shape with four channels": (_header(shape=[1, 4, 1, 4, 4]), "shape"),
    "shape with rows": (_header(shape=[1, 4, 4, 4, 1]), "shape"),
    "matrix zero": (_header(matrix=[0] * 16), "transform"),
    "matrix a text": (_header(matrix="abc"), "transform"),
    "matrix NaN": (_header(matrix=[NAN] * 16), "transform"),
    "digests a list": (_header(digests=[]), "digests"),
    "surroundings a list": (_header(digests={"surroundings": []}), "digests"),
}


def _move_vertex() -> None:
    bpy.data.objects["Cube"].data.vertices[0].co.x -= 0.1


STALE: dict[str, tuple[Build, str]] = {
    "vertex moved": (_move_vertex, "Cube: "),
    "object moved": (lambda: _set(bpy.data.objects["Cube"], "location", (1, 0, 0)), "Cube: "),
    "object no longer finite": (lambda: _set(bpy.data.objects["Cube"], "location", (NAN, 0, 0)), "Cube: "),
    "modifier added": (lambda: bpy.data.objects["Cube"].modifiers.new("s", "SUBSURF"), "Cube: "),
    "material changed": (lambda: paint(bpy.data.objects["Cube"], 1, 0, 0), "Cube: "),
    "neighbour hidden": (lambda: _set(bpy.data.objects["Floor"], "hide_render", True), "Floor"),
    "neighbour added": (lambda: cube("New", x=4.0), "New"),
}


# All verbs read through the same function, so the others than relight are tried on one case of each kind.
REFUSED = [*((case, "relight") for case in (*BROKEN, *STALE)),
           *((case, verb) for case in ("NaN bases", "schema newer", "vertex moved") for verb in ("preview", "export"))]


@pytest.mark.parametrize(("case", "verb"), REFUSED)
def test_broken_or_stale_data_is_refused(case: str, verb: str, baked: Path, prt: Callable[..., Outcome],
                                         tmp_path: Path) -> None:
    change, words = (BROKEN | STALE)[case]
    bpy.ops.wm.open_mainfile(filepath=str(baked))
    change()
    source = saved(tmp_path / "in.blend")
    output = tmp_path / {"relight": "c.npz", "preview": "p.png", "export": "out"}[verb]
    found = prt(verb, "--input", source, "--output", output)
    assert found.code == 1 and len(found.lines) == 1 and words in found.lines[0], found
    assert ("stale" in found.lines[0]) == (case in STALE) and "ake" in found.lines[0]  # the remedy: bake
    assert [p.name for p in tmp_path.iterdir()] == ["in.blend"]


def test_a_curve_edited_after_its_bake_is_stale(prt: Callable[..., Outcome], tmp_path: Path) -> None:
    new_scene()
    _curve(0.2)
    output = tmp_path / "out.blend"
    assert prt("bake", "--input", saved(tmp_path / "in.blend"), "--output", output, *FAST).code == 0
    bpy.ops.wm.open_mainfile(filepath=str(output))
    bpy.data.objects["Curve"].data.bevel_depth = 0.4
    found = prt("relight", "--input", saved(tmp_path / "edited.blend"), "--output", tmp_path / "c.npz")
    assert found.code == 1 and "stale" in found.lines[0]


def test_unbaked_files_are_refused(prt: Callable[..., Outcome], tmp_path: Path) -> None:
    new_scene()
    cube()
    source = saved(tmp_path / "in.blend")
    for verb, name in (("relight", "c.npz"), ("preview", "p.png"), ("export", "out")):
        found = prt(verb, "--input", source, "--output", tmp_path / name)
        assert found.code == 1 and "no object in it is baked" in found.lines[0] and len(found.lines) == 1
    assert [p.name for p in tmp_path.iterdir()] == ["in.blend"]


# ---- Light, cameras, arguments ---------------------------------------------------------------------------------------

def _exr(path: Path, pixels: np.ndarray) -> Path:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": np.asarray(pixels, np.float32)}).write(str(path))
    return path


WHITE = np.ones((8, 16, 3), np.float32)


def _with(value: float) -> np.ndarray:
    pixels = WHITE.copy()
    pixels[2, 3] = value
    return pixels


@pytest.mark.parametrize(("name", "content"), [
    ("absent.exr", None), ("text.exr", b"hello"), ("empty.exr", b""), ("text.hdr", b"#?RADIANCE\n"),
    ("picture.png", b"\x89PNG"), ("nan.exr", _with(NAN)), ("inf.exr", _with(float("inf"))), ("cut.exr", "cut"),
    ("folder.exr", "folder"),
], ids=lambda value: value if isinstance(value, str) and "." in value else "")
def test_an_environment_that_is_no_image_is_named(name: str, content: object, baked: Path, tmp_path: Path,
                                                  prt: Callable[..., Outcome]) -> None:
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif isinstance(content, np.ndarray):
        _exr(path, content)
    elif content == "cut":
        path.write_bytes(_exr(path, WHITE).read_bytes()[:-30])
    elif content == "folder":
        path.mkdir()
    found = prt("relight", "--input", baked, "--output", tmp_path / "c.npz", "--environment", path)
    assert found.code == 1 and len(found.lines) == 1 and name in found.lines[0], found
    assert not (tmp_path / "c.npz").exists()


@pytest.mark.parametrize("pixels", [WHITE[:1, :1], WHITE[:1, :7], WHITE[:7, :1], WHITE, 0.0 * WHITE, -WHITE,
                                    _with(-5.0), _with(1e30)],
                         ids=["1x1", "1x7", "7x1", "white", "black", "negative", "one negative", "one of 1e30"])
def test_odd_environments_light_linearly(pixels: np.ndarray, baked: Path, tmp_path: Path,
                                         prt: Callable[..., Outcome]) -> None:
    """A uniform picture of any size and sign is that multiple of the white sky; nothing overflows."""
    found = prt("relight", "--input", baked, "--output", tmp_path / "c.npz", "--environment",
                _exr(tmp_path / "e.exr", pixels), "--rotate", "1e18")
    assert found.code == 0
    radiance = np.load(tmp_path / "c.npz")["radiance"]
    assert np.isfinite(radiance).all()
    if np.ptp(pixels) == 0.0:
        assert prt("relight", "--input", baked, "--output", tmp_path / "w.npz").code == 0
        assert radiance == pytest.approx(pixels[0, 0, 0] * np.load(tmp_path / "w.npz")["radiance"], abs=1e-4)


@pytest.mark.parametrize("arguments", [
    ["relight", "--rotate", "nan"], ["relight", "--rotate", "inf"], ["relight", "--rotate=-inf"],
    ["relight", "--rotate", ""], *(["preview", f"--size={size}"] for size in (
        "64", "0x5", "-4x4", "4x", "x", "axb", "1e3x5", "4x4x4", "²x2", "999999x2", "9" * 30 + "x1", "16385x1")),
    *(["bake", "--set", pair] for pair in (
        "order=0", "order=2.5", "order=", "=3", "order", "spacing=nan", "spacing=-1", "clusters=5000", "vectors=25",
        "encoder=best", "bounce_error=0", "fit_order_to_light=maybe", "seed=-1", "colour=red", "order=" + "9" * 5000)),
    ["bake", "--preset", "ultra"], ["bake", "--objects", ","], ["bake", "--lighting", "moon"], ["bake", "--bogus"],
    ["bake", "--lighting", ""], ["bake", "--lighting", "local,moon"], ["bake", "--set", "lighting=moon"],
    ["bake", "--report", "r.txt"], ["bake", "--output", "x.txt"], ["bake", "--output", ""], ["relight"],
    ["bake", "--output", "LINK"],
], ids=lambda arguments: " ".join(arguments)[:40])
def test_senseless_arguments_end_in_2(arguments: list[str], baked: Path, tmp_path: Path,
                                      monkeypatch: pytest.MonkeyPatch, prt: Callable[..., Outcome]) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link.blend").symlink_to(baked)
    name = {"relight": "c.npz", "preview": "p.png", "bake": "o.blend"}[arguments[0]]
    output = [] if arguments == ["relight"] or "--output" in arguments else ["--output", tmp_path / name]
    given = [str(tmp_path / "link.blend") if a == "LINK" else a for a in arguments]
    found = prt(given[0], "--input", baked, *output, *given[1:])
    assert found.code == 2 and len(found.lines) == 1, found
    assert [p.name for p in tmp_path.iterdir()] == ["link.blend"]


@pytest.mark.parametrize(("change", "words"), [
    (lambda: bpy.data.objects.remove(bpy.data.objects["Camera"]), "no active camera"),
    (lambda: _set(bpy.context.scene, "camera", bpy.data.objects["Cube"]), "Cube: "),
    (lambda: _set(bpy.data.cameras[0], "type", "PANO"), "Camera: "),
    (lambda: _set(bpy.data.objects["Camera"], "scale", (0, 0, 0)), "Camera: "),
    (lambda: _set(bpy.data.objects["Camera"], "location", (NAN, 0, 0)), "Camera: "),
], ids=["none", "a mesh", "panoramic", "scale zero", "NaN"])
def test_a_camera_that_sees_nothing_is_named(change: Build, words: str, baked: Path, tmp_path: Path,
                                             prt: Callable[..., Outcome]) -> None:
    bpy.ops.wm.open_mainfile(filepath=str(baked))
    change()
    found = prt("preview", "--input", saved(tmp_path / "in.blend"), "--output", tmp_path / "p.png", "--size", "8x8")
    assert found.code == 1 and len(found.lines) == 1 and words in found.lines[0], found
    assert not (tmp_path / "p.png").exists()


# ---- Files -----------------------------------------------------------------------------------------------------------

def test_files_that_are_no_blend_files(baked: Path, tmp_path: Path, prt: Callable[..., Outcome]) -> None:
    source, whole = tmp_path / "x.blend", baked.read_bytes()
    for content in (b"", b"text", whole[:len(whole) // 2], whole[:-100]):
        source.write_bytes(content)
        found = prt("analyze", "--input", source)
        assert found.code == 1 and len(found.lines) == 1 and "x.blend: " in found.lines[0]
    for never_saved in (tmp_path / "unsaved.blend", tmp_path, tmp_path / ("x" * 300 + ".blend")):
        found = prt("analyze", "--input", never_saved)
        assert found.code in (1, 2) and len(found.lines) == 1, found


@pytest.mark.parametrize("place", ["file/o.blend", "absent/o.blend", "/proc/o.blend", "x" * 300 + ".blend",
                                   "closed/o.blend", "kept.blend"], ids=lambda place: place[:16])
def test_outputs_that_cannot_be_written_are_refused_before_the_work(place: str, baked: Path, tmp_path: Path, jobs: Path,
                                                                    prt: Callable[..., Outcome]) -> None:
    """Marked read-only is read-only for the administrator too, who could write it."""
    (tmp_path / "file").write_text("kept")
    (tmp_path / "kept.blend").write_text("kept")
    (tmp_path / "kept.blend").chmod(0o444)
    (tmp_path / "closed").mkdir(mode=0o555)
    before = sorted(tmp_path.rglob("*"))
    found = prt("bake", "--input", baked, "--output", tmp_path / place, *FAST)
    assert found.code == 1 and len(found.lines) == 1, found
    assert sorted(tmp_path.rglob("*")) == before and (tmp_path / "kept.blend").read_text() == "kept"
    assert not list(jobs.iterdir())


def test_a_full_disk_keeps_the_previous_result_and_the_finished_stages(
        baked: Path, tmp_path: Path, jobs: Path, prt: Callable[..., Outcome], monkeypatch: pytest.MonkeyPatch) -> None:
    """A limit on file size while saving stands for the full disk: the system refuses the same write."""
    from prt.operators import verbs

    save = verbs.save_blend

    def save_on_full_disk(path: Path) -> None:
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1024, limits[1]))
        try:
            save(path)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    output = tmp_path / "o.blend"
    output.write_text("previous")
    monkeypatch.setattr(verbs, "save_blend", save_on_full_disk)
    found = prt("bake", "--input", baked, "--output", output, *FAST)
    assert found.code == 1 and len(found.lines) == 1 and "can't be written" in found.lines[0], found
    assert output.read_text() == "previous" and [p.name for p in tmp_path.iterdir()] == ["o.blend"]
    finished = next(jobs.glob("bake-*/result.npz")).stat().st_mtime_ns
    monkeypatch.setattr(verbs, "save_blend", lambda path: (
        save(path), pytest.fail("baked again") if next(jobs.glob("bake-*/result.npz")).stat().st_mtime_ns != finished
        else None))
    assert prt("bake", "--input", baked, "--output", output, *FAST).code == 0
    assert not list(jobs.iterdir()) and not hidden(tmp_path)


@pytest.mark.parametrize("stage", ["scene", "gather", "direct", "interreflection", "result"])
def test_a_broken_stage_is_made_again(stage: str, baked: Path, tmp_path: Path, jobs: Path, prt: Callable[..., Outcome],
                                      monkeypatch: pytest.MonkeyPatch) -> None:
    """A power cut may leave half a file; "bake again" has to help."""
    from prt.prt_addon.baking import job

    with monkeypatch.context() as patch:
        patch.setattr(job, "discard", lambda folder: None)
        assert prt("bake", "--input", baked, "--output", tmp_path / "a.blend", *FAST).code == 0
    folder = next(jobs.iterdir())
    if stage != "result":
        (folder / "result.npz").unlink()
    path = folder / f"{stage}.npz"
    path.write_bytes(path.read_bytes()[:100])
    assert prt("bake", "--input", baked, "--output", tmp_path / "a.blend", *FAST).code == 0
    assert not list(jobs.iterdir())


@pytest.mark.parametrize("content", [None, b"", b"[]", b"{", b'{"schema": 99}', b'{"schema": 1}', b"\xff\xfe"])
def test_reports_that_are_none(content: bytes | None, tmp_path: Path, prt: Callable[..., Outcome]) -> None:
    if content is not None:
        (tmp_path / "r.json").write_bytes(content)
    found = prt("report", "--input", tmp_path / "r.json", "--output", tmp_path / "r.html")
    assert found.code in (1, 2) and len(found.lines) == 1 and "r.json" in found.lines[0]
    assert not (tmp_path / "r.html").exists()


# ---- The program itself ----------------------------------------------------------------------------------------------

def _start(arguments: list[object], tmp_path: Path, **options: object) -> subprocess.Popen:
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "user")}
    return subprocess.Popen([sys.executable, str(TOOL), *map(str, arguments)], stderr=subprocess.PIPE, text=True,
                            **{"env": environment, "stdout": subprocess.PIPE, **options})


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize("seconds", [0.3, 0.7])
def test_interrupted_while_blender_starts(seconds: float, baked: Path, tmp_path: Path) -> None:
    """Blender swallows an interrupt while it starts and goes on without half its add-ons."""
    output = tmp_path / "o.blend"
    running = _start(["bake", "--input", baked, "--output", output, *FAST], tmp_path)
    time.sleep(seconds)
    running.send_signal(signal.SIGINT)
    errors = running.communicate(timeout=60)[1]
    assert running.returncode == 3 and "Traceback" not in errors and not output.exists(), errors


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="looks for the child in /proc")
def test_a_killed_child_is_one_line_and_leaves_its_stages(baked: Path, tmp_path: Path) -> None:
    output = tmp_path / "o.blend"
    output.write_text("previous")
    running = _start(["bake", "--input", baked, "--output", output, *FAST, "--set", "error_receivers=256", "--set",
                      "error_paths=65536"], tmp_path)
    for line in running.stderr:
        if "Measuring" in line:
            break
    children = Path(f"/proc/{running.pid}/task/{running.pid}/children").read_text().split()
    assert len(children) == 1
    os.kill(int(children[0]), signal.SIGKILL)
    errors = [line for line in running.communicate(timeout=30)[1].splitlines() if "%" not in line]
    assert running.returncode == 1 and len(errors) == 1 and "SIGKILL" in errors[0] and "resume" in errors[0], errors
    assert output.read_text() == "previous" and not hidden(tmp_path)
    assert {"direct.npz", "gather.npz"} <= {p.name for p in (tmp_path / "user").rglob("*.npz")}


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_results_that_nobody_takes_are_one_line(baked: Path, tmp_path: Path) -> None:
    with open("/dev/full", "w") as full:
        running = _start(["analyze", "--input", baked], tmp_path, stdout=full)
        errors = running.communicate(timeout=60)[1]
    lines = [line for line in errors.splitlines() if line.startswith("prt")]
    assert running.returncode == 1 and len(lines) == 1 and "Traceback" not in errors, errors


def test_a_user_folder_that_cannot_be_written(baked: Path, tmp_path: Path) -> None:
    """The job folder can't be made: said in a line, and nothing is written elsewhere instead."""
    (tmp_path / "user").write_text("a file")
    running = _start(["bake", "--input", baked, "--output", tmp_path / "o.blend", *FAST], tmp_path, cwd=tmp_path)
    errors = running.communicate(timeout=60)[1]
    lines = [line for line in errors.splitlines() if line.startswith("prt")]
    assert running.returncode == 1 and len(lines) == 1 and "Traceback" not in errors, errors
    assert [p.name for p in tmp_path.iterdir()] == ["user"]


def test_a_read_only_file_system(baked: Path, tmp_path: Path, prt: Callable[..., Outcome]) -> None:
    """A folder that even the administrator can't write to."""
    folder = tmp_path / "immutable"
    folder.mkdir()
    if not shutil.which("chattr") or subprocess.run(["chattr", "+i", str(folder)], capture_output=True).returncode:
        pytest.skip("no right to make a folder immutable")
    try:
        found = prt("relight", "--input", baked, "--output", folder / "c.npz")
        assert found.code == 1 and len(found.lines) == 1, found
        found = prt("bake", "--input", baked, "--output", folder / "o.blend", *FAST)
        assert found.code == 1 and len(found.lines) == 1, found
        found = prt("export", "--input", baked, "--output", folder / "out")
        assert found.code == 1 and len(found.lines) == 1, found
    finally:
        subprocess.run(["chattr", "-i", str(folder)], check=True)
    assert not list(folder.iterdir())
