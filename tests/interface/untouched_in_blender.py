# SPDX-License-Identifier: GPL-3.0-or-later
"""Nothing of the user's is touched without being asked: every plain property of every data-block of the file is
compared before and after a bake, a cancel, the preview, an undo and a clear. Started by run.py.
"""

from __future__ import annotations

import hashlib
import re
import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parent))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from driving import (
    SCENE,
    Step,
    baked_names,
    carrier,
    children,
    invoke_bake,
    override,
    select,
    session,
    shoot,
    start,
    until,
    wait_for_bake,
)

from tests.blender.scenes import user_data_lines

# What a bake may change: attributes of the meshes that it is stored on, and receiver objects of its own.
ITS_OWN = re.compile(r"attributes|PRT |prt_| users |objects count|objects\[\d+\]")
# A bake's data in meshes, objects and scenes; the settings of a scene stay.
LEFT_BEHIND = re.compile(r"^(meshes|objects)\..*(prt_|PRT )|\['prt_(?!light)")
# Blender sets it to the active object some time after that changed.
BLENDERS_OWN = "tool_settings.particle_edit.object->"


def state(own: bool = True) -> list[str]:
    """Everything in the file, line by line; own=False leaves out what a bake may change."""
    with override():
        lines = [line for line in user_data_lines() if BLENDERS_OWN not in line]
    lines.append(f"frame {bpy.context.scene.frame_current}")
    for mesh in bpy.data.meshes:  # coordinates and custom properties are no plain properties
        digest = hashlib.blake2b(digest_size=8)
        for vertex in mesh.vertices:
            digest.update(repr(tuple(vertex.co)).encode())
        lines.append(f"meshes.{mesh.name} at {digest.hexdigest()}")
    for group in (bpy.data.objects, bpy.data.meshes, bpy.data.scenes, bpy.data.worlds):
        lines += [f"{block.name}[{key!r}]" for block in group for key in sorted(block.keys()) if key != "prt"]
    if own:
        return sorted(lines)
    return sorted(line for line in lines if not ITS_OWN.search(line))


def same(before: list[str], after: list[str], what: str) -> None:
    """Fails with the first lines in which two states differ."""
    gone, new = sorted(set(before) - set(after)), sorted(set(after) - set(before))
    assert not gone and not new, f"{what} changed {len(gone) + len(new)} lines: was {gone[:5]}, is {new[:5]}"


def make_a_mess() -> Step:
    """A file as users have them: another add-on's data, UV maps, groups, a frame in the middle, odd selections."""
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(SCENE), load_ui=False)
    yield 2.0
    statue, wall = bpy.data.objects["Statue"], bpy.data.objects["Wall"]
    statue["other_addon"], statue.data["other_addon"] = "kept", 3.5
    statue.vertex_groups.new(name="Ears").add([1, 2, 3], 0.5, "REPLACE")
    statue.data.uv_layers.new(name="Second")
    statue.data.attributes.new("other_attribute", "FLOAT", "POINT").data.foreach_set(
        "value", [0.5] * len(statue.data.vertices))
    wall.modifiers.new("Rounded", "BEVEL").width = 0.02
    wall.lock_location[0] = True
    scene = bpy.context.scene
    scene.frame_set(17)
    scene.timeline_markers.new("Here", frame=5)
    scene.cursor.location = (1.0, 2.0, 3.0)
    bpy.context.scene.prt.preset = "draft"
    bpy.data.objects["Floor"].hide_select = True
    yield 1.0


def bake_one() -> Step:
    """Baking one object changes nothing but its own data, and leaves the other's bake alone."""
    select("Wall")
    yield 1.0  # Blender notes the new active object in tool settings, too
    before = state(own=False)
    assert invoke_bake() == {"RUNNING_MODAL"}
    yield from wait_for_bake()
    assert not session().failed, session().message
    same(before, state(own=False), "the first bake")
    yield from until(lambda: baked_names() == {"Wall"}, "the bake is not listed")
    wall = carrier("Wall")
    header, weights = wall["prt_header"], _weights(wall)
    select("Statue")
    with override():
        bpy.ops.ed.undo_push(message="Select")  # as a click does
    yield 1.0
    before, everything = state(own=False), state()
    assert invoke_bake() == {"RUNNING_MODAL"}
    yield from wait_for_bake()
    same(before, state(own=False), "the second bake")
    assert carrier("Wall")["prt_header"] == header and _weights(carrier("Wall")) == weights
    assert [o.name for o in bpy.context.selected_objects] == ["Statue"], "the selection changed"
    with override():
        bpy.ops.ed.undo()
    yield 1.0
    same(everything, state(), "undo after a bake: what was before it")
    assert carrier("Statue") is None and carrier("Wall")["prt_header"] == header


def cancel() -> Step:
    """A cancelled bake changes nothing at all."""
    select("Statue")
    bpy.context.scene.prt.preset = "high"
    before = state()
    assert invoke_bake() == {"RUNNING_MODAL"}
    yield 1.0
    assert bpy.ops.prt.cancel() == {"FINISHED"}
    yield from until(lambda: not session().running and not children(), "the bake does not end")
    same(before, state(), "a cancelled bake")
    bpy.context.scene.prt.preset = "draft"


def look() -> Step:
    """The preview, switched on and off, and an analysis change nothing at all."""
    yield from until(lambda: baked_names() == {"Wall"}, "the bake is not listed")
    before = state()
    with override():
        assert bpy.ops.prt.toggle_preview() == {"FINISHED"}
    yield 2.0
    shoot("untouched_preview")
    same(before, state(), "the preview")
    with override():
        assert bpy.ops.prt.analyze() == {"FINISHED"}
        assert bpy.ops.prt.toggle_preview() == {"FINISHED"}
    yield 1.0
    same(before, state(), "the analysis")


def clear() -> Step:
    """Clear gives the file back as it was before the first bake, relit colours included."""
    with override():
        assert bpy.ops.prt.relight() == {"FINISHED"}
        bpy.ops.ed.undo()
    yield 1.0
    select()
    with override():
        assert bpy.ops.prt.clear() == {"FINISHED"}
    yield from until(lambda: not baked_names(), "clear left a bake")
    left = [line for line in state() if LEFT_BEHIND.search(line)]
    assert not left, f"clear left data behind: {left[:5]}"


def _weights(mesh: bpy.types.Mesh) -> list[float]:
    values = [0.0] * (4 * len(mesh.vertices))
    mesh.attributes["prt_weights_0"].data.foreach_get("vector", values)
    return values


start((make_a_mess, bake_one, cancel, look, clear), "untouched")
