# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes whose whole set was moved after them: against the same lamps moved along, and against a fresh bake there."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from tests.blender.test_local_light_bakes import FAST, make_room, run

TURN = Matrix.Translation((4.0, -1.0, 2.0)) @ Matrix.Rotation(np.pi / 2, 4, "Z") @ Matrix.Rotation(np.pi / 2, 4, "X")


def bake(source: Path, output: Path, lighting: str) -> None:
    assert run("bake", "--input", source, "--output", output, "--lighting", lighting, "--set", "cloud_region=Region",
               *FAST, "--set", "cloud_lights=64") == 0


def relight(source: Path, output: Path) -> dict[str, np.ndarray]:
    assert run("relight", "--input", source, "--output", output, "--use-scene-lights") == 0
    with np.load(output) as arrays:
        return {name: arrays[name] for name in arrays.files}


def move(source: Path, output: Path, matrix: Matrix, with_lamps: bool) -> None:
    """All meshes (and lamps) on an empty that is then moved."""
    bpy.ops.wm.open_mainfile(filepath=str(source))
    holder = bpy.data.objects.new("Holder", None)
    bpy.context.scene.collection.objects.link(holder)
    for found in bpy.context.scene.objects:
        if found.type in ("MESH", "EMPTY") or (with_lamps and found.type == "LIGHT"):
            found.parent = found.parent or (holder if found != holder else None)
    holder.matrix_world = matrix
    bpy.context.view_layer.update()
    if with_lamps:  # a lamp of the same brightness where everything has grown
        for lamp in bpy.data.lights:
            lamp.energy *= matrix.to_scale().x ** 2
            lamp.shadow_soft_size *= matrix.to_scale().x
    bpy.ops.wm.save_as_mainfile(filepath=str(output))


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A room under a sky of two colours and a soft lamp, not yet baked."""
    path = make_room(tmp_path_factory.mktemp("moved") / "room.blend")
    bpy.ops.wm.open_mainfile(filepath=str(path))
    tree = bpy.context.scene.world.node_tree
    gradient, place = tree.nodes.new("ShaderNodeTexGradient"), tree.nodes.new("ShaderNodeTexCoord")
    tree.links.new(place.outputs["Generated"], gradient.inputs["Vector"])
    tree.links.new(gradient.outputs["Color"], tree.nodes["Background"].inputs["Color"])
    bpy.data.lights[0].shadow_soft_size = 0.1
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


def test_lamps_that_come_along_light_as_before(room: Path, tmp_path: Path) -> None:
    """Everything moved and grown together: nothing changes but places, whatever the lamps are made of."""
    baked, moved = tmp_path / "baked.blend", tmp_path / "moved.blend"
    bake(room, baked, "local")
    before = relight(baked, tmp_path / "before.npz")
    matrix = TURN @ Matrix.Scale(2.0, 4)
    move(baked, moved, matrix, with_lamps=True)
    after = relight(moved, tmp_path / "after.npz")
    assert np.abs(after["radiance"] - before["radiance"]).max() < 5e-3 * before["radiance"].max()
    expected = before["position"] @ np.array(matrix)[:3, :3].T + np.array(matrix)[:3, 3]
    assert np.allclose(after["position"], expected, atol=1e-4)
    assert np.allclose(after["normal"], before["normal"] @ np.array(TURN)[:3, :3].T, atol=1e-4)


@pytest.mark.parametrize("lighting", ["environment", "environment,local"])
def test_a_moved_set_is_lit_as_a_fresh_bake_there(room: Path, tmp_path: Path, lighting: str) -> None:
    """Sky and lamps stay where they are."""
    turn = Matrix.Rotation(np.pi / 2, 4, "Z") @ Matrix.Translation((0.05, 0.1, 0.0))
    baked, moved, fresh = (tmp_path / f"{name}.blend" for name in ("baked", "moved", "fresh"))
    bake(room, baked, lighting)
    still = relight(baked, tmp_path / "still.npz")["radiance"]
    move(baked, moved, turn, with_lamps=False)
    found = relight(moved, tmp_path / "found.npz")["radiance"]
    move(room, fresh, turn, with_lamps=False)
    bake(fresh, fresh.with_name("fresh_baked.blend"), lighting)
    expected = relight(fresh.with_name("fresh_baked.blend"), tmp_path / "expected.npz")["radiance"]
    scale = np.sqrt((expected ** 2).mean())
    assert np.sqrt(((still - expected) ** 2).mean()) > 0.2 * scale, "the move makes no difference"
    assert np.sqrt(((found - expected) ** 2).mean()) < 0.03 * scale


def test_one_moved_object_is_refused(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    baked, moved = tmp_path / "baked.blend", tmp_path / "moved.blend"
    bake(room, baked, "environment")
    bpy.ops.wm.open_mainfile(filepath=str(baked))
    bpy.data.objects["Left"].location.x -= 0.1
    bpy.ops.wm.save_as_mainfile(filepath=str(moved))
    assert run("relight", "--input", moved, "--output", tmp_path / "c.npz") == 1
    assert "stale" in capsys.readouterr().err
