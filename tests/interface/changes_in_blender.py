# SPDX-License-Identifier: GPL-3.0-or-later
"""What the viewport shows after the file's data changed: run by run.py, one step per timer call (driving.py).

Moved, undone, renamed, copied, deleted, appended, linked, another scene: right as the CPU says (comparing.py), or
dimmed and said to be stale; never silently wrong.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

sys.path.insert(0, str(Path(__file__).parent))  # Blender runs this file by its path

from comparing import check_view, core, oracle
from driving import (
    DRAWN,
    OUTPUT,
    SCENE,
    Step,
    area,
    baked_names,
    override,
    region,
    select,
    session,
    shoot,
    start,
    until,
    view,
    wait_for_bake,
    window,
)
from views_in_blender import BAKED, QUICK, look, open_and_bake, space, steady

SAVED = OUTPUT / "changes_baked.blend"


def stale_names() -> set[str]:
    return {line.name for line in session().objects if line.stale}


def becomes_stale(*names: str) -> Step:
    yield from until(lambda: stale_names() == set(names), f"stale are {stale_names()}, not {set(names)}")


def drawn() -> set[str]:
    """Full names of the objects that a redraw of the viewport would draw."""
    with bpy.context.temp_override(window=window(), area=area(), region=region()):
        return {item.key[1] for item in core("operators.live_preview").draw_list()}


def bake_once() -> Step:
    """As in the other script, and saved."""
    yield from open_and_bake()
    with override():
        bpy.ops.wm.save_as_mainfile(filepath=str(SAVED))
    yield 0.5


def fresh() -> Step:
    """The baked file as it was saved: what every step starts from, whatever became of the one before."""
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(SAVED), load_ui=False)
    yield from until(lambda: baked_names() == BAKED and not stale_names(), "the baked file is not there again")
    steady()
    yield 0.5


def undo_push(message: str) -> None:
    with override():
        bpy.ops.ed.undo_push(message=message)


def move_the_set() -> Step:
    """All on one empty, turned by 90 degrees, shifted, grown: the light goes the other way, nothing is stale, and the
    picture is a fresh bake's."""
    steady()
    holder = bpy.data.objects.new("Holder", None)
    bpy.context.scene.collection.objects.link(holder)
    for scene_object in bpy.context.scene.objects:
        if scene_object.type == "MESH":
            scene_object.parent = holder
    undo_push("parented")
    yield from check_view("c01_parented", BAKED)
    before = view(shoot("c01_before"))
    holder.matrix_world = Matrix.Translation((0.2, 0.1, 0.3)) @ Matrix.Rotation(math.pi / 2, 4, "Z")
    picture = yield from check_view("c02_turned", BAKED)
    assert not stale_names() and np.abs(view(picture) - before).mean() > 1.0
    holder.matrix_world = holder.matrix_world @ Matrix.Scale(0.7, 4)
    undo_push("turned and shrunk")
    yield from check_view("c03_shrunk", BAKED)
    assert not stale_names()
    moved = radiances()
    select(*BAKED)
    with override():
        assert bpy.ops.prt.bake("INVOKE_DEFAULT", overrides=QUICK) == {"RUNNING_MODAL"}
    yield from wait_for_bake()
    select()
    yield from check_view("c04_fresh", BAKED)
    fresh = radiances()
    error = np.sqrt(((moved - fresh) ** 2).mean() / (fresh ** 2).mean())
    print(f"a moved bake differs from a fresh one by {100.0 * error:.2f} %", flush=True)
    assert error < 0.04, f"a moved bake is {100.0 * error:.1f} % off"
    with override():
        bpy.ops.ed.undo()
    yield from check_view("c05_bake_undone", BAKED)
    with override():
        bpy.ops.ed.undo()
    yield from check_view("c06_move_undone", BAKED)
    assert not stale_names()


def radiances() -> np.ndarray:
    """Radiance towards the eye of all receivers, (p, 3), from the CPU."""
    return np.concatenate([radiance for _, _, radiance in oracle(space().region_3d, BAKED).values()])


def move_one() -> Step:
    """One of several moves: all are dimmed and said to be stale until it is back; undo and redo follow."""
    yield from fresh()
    undo_push("before")
    ball = bpy.data.objects["Ball"]
    ball.location.x += 0.4
    undo_push("moved")
    yield from becomes_stale(*BAKED)
    yield from check_view("c10_one_moved", {"Floor", "Wall"})
    with override():
        bpy.ops.ed.undo()
    yield from becomes_stale()
    yield from check_view("c11_move_undone", BAKED)
    with override():
        bpy.ops.ed.redo()
    yield from becomes_stale(*BAKED)
    with override():
        bpy.ops.ed.undo()
    yield from becomes_stale()


def edit_what_counts() -> Step:
    """A modifier, a mesh, a material, another object's material, an animated place: each makes bakes stale, and putting
    it back makes them valid."""
    yield from fresh()
    ball, wall, post = (bpy.data.objects[name] for name in ("Ball", "Wall", "Post"))
    changes: tuple[tuple[str, Callable[[], object], Callable[[], object]], ...] = (
        ("modifier", lambda: ball.modifiers.new("Cast", "CAST"), lambda: ball.modifiers.clear()),
        ("mesh", lambda: lift(wall, 0.1), lambda: lift(wall, 0.0)),
        ("material", lambda: paint(wall, 0.1), lambda: paint(wall, 0.8)),
        ("material of another", lambda: paint(post, 0.9), lambda: paint(post, 0.1)),
    )
    for name, change, back in changes:
        change()
        yield from becomes_stale(*BAKED)
        if name == "material":
            yield from check_view("c12_stale", {"Floor", "Wall"})
        back()
        yield from becomes_stale()
    swapped = wall.data
    wall.data = bpy.data.meshes["Floor"].copy()
    yield from until(lambda: stale_names() == BAKED, f"another mesh: {stale_names()}")
    wall.data = swapped
    yield from becomes_stale()
    ball.keyframe_insert("location", frame=1)
    ball.location.z += 0.3
    ball.keyframe_insert("location", frame=10)
    bpy.context.scene.frame_set(10)
    yield from becomes_stale(*BAKED)
    bpy.context.scene.frame_set(1)
    yield from becomes_stale()
    ball.animation_data_clear()
    yield from check_view("c13_all_back", BAKED)


def lift(scene_object: bpy.types.Object, height: float) -> None:
    scene_object.data.vertices[0].co.z = height
    scene_object.data.update()


def paint(scene_object: bpy.types.Object, red: float) -> None:
    shader = scene_object.data.materials[0].node_tree.nodes["Principled BSDF"]
    colour = shader.inputs["Base Color"].default_value
    shader.inputs["Base Color"].default_value = (red, *colour[1:])


def rename_and_delete() -> Step:
    """A renamed object keeps its bake; a deleted one is not drawn, and undo brings it back."""
    yield from fresh()
    wall = bpy.data.objects["Wall"]
    wall.name = "Partition"
    yield from until(lambda: baked_names() == {"Floor", "Partition", "Ball"}, f"the panel lists {baked_names()}")
    yield from check_view("c20_renamed", {"Floor", "Partition", "Ball"})
    assert drawn() == {"Floor", "Partition", "Ball"} and not stale_names()
    wall.name = "Wall"
    yield from until(lambda: baked_names() == BAKED, f"the panel lists {baked_names()}")
    undo_push("renamed")
    select("Wall")
    with override():
        bpy.ops.object.delete()
    yield from until(lambda: baked_names() == {"Floor", "Ball"}, f"the panel lists {baked_names()}")
    yield from becomes_stale("Floor", "Ball")
    assert drawn() == {"Floor", "Ball"}
    yield from check_view("c21_deleted", {"Floor", "Ball"})
    with override():
        bpy.ops.ed.undo()
    yield from until(lambda: baked_names() == BAKED, f"the panel lists {baked_names()}")
    yield from becomes_stale()
    yield from check_view("c22_delete_undone", BAKED)


def duplicate() -> Step:
    """Copies, linked or full, show light of another place: all are dimmed and said to be stale."""
    yield from fresh()
    for linked in (True, False):
        undo_push("before")
        select("Ball")
        with override():
            bpy.ops.object.duplicate(linked=linked)
        bpy.data.objects["Ball.001"].location.x -= 1.0
        select()
        yield from until(lambda: stale_names() == {*BAKED, "Ball.001"}, f"stale are {stale_names()}")
        yield from check_view(f"c23_duplicate_{linked}", BAKED)
        bpy.data.objects.remove(bpy.data.objects["Ball.001"])
        yield from until(lambda: baked_names() == BAKED and not stale_names(), f"stale are {stale_names()}")
    yield from check_view("c24_without_copies", BAKED)


def switch_scenes() -> Step:
    """Another scene has its own bakes and light; back in the first, all is as before. A second view layer, too."""
    yield from fresh()
    first = bpy.context.scene
    with override():
        bpy.ops.scene.new(type="NEW")
    second = window().scene
    assert second != first
    yield from until(lambda: not baked_names(), f"the panel lists {baked_names()}")
    assert not drawn()
    window().scene = first
    yield from until(lambda: baked_names() == BAKED, f"the panel lists {baked_names()}")
    yield from check_view("c30_first_scene_again", BAKED)
    bpy.data.scenes.remove(second)
    with override():
        bpy.ops.scene.new(type="LINK_COPY")
    copy = window().scene
    world = first.world.copy()
    copy.world = world
    world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.2
    copy.prt.exposure = 0.5
    yield from check_view("c31_linked_scene", BAKED)
    window().scene = first
    yield from check_view("c32_first_scene", BAKED)
    bpy.data.scenes.remove(copy)
    layer = first.view_layers.new("Second")
    window().view_layer = layer
    yield from check_view("c33_second_layer", BAKED)
    window().view_layer = first.view_layers[0]
    first.view_layers.remove(layer)
    yield from check_view("c34_first_layer", BAKED)


def append_and_link() -> Step:
    """Objects with bakes from another file: listed and drawn at once. The whole set is valid, a part of it is stale."""
    yield from fresh()
    with override():
        bpy.ops.wm.read_homefile(use_empty=True, load_ui=False)
    yield DRAWN
    assert session().preview and not baked_names() and not drawn()
    light_up()
    for link in (False, True):
        with bpy.data.libraries.load(str(SAVED), link=link) as (_, into):
            into.objects = ["Floor", "Wall", "Ball", "Post", "Lamp", "Sun"]
        held = list(into.objects)
        for scene_object in held:
            bpy.context.scene.collection.objects.link(scene_object)
        names = {o.name_full for o in held if o.name in BAKED}
        yield from until(lambda n=names: baked_names() == n, f"the panel lists {baked_names()}")
        yield from becomes_stale()
        look()
        yield from check_view(f"c40_{'linked' if link else 'appended'}", BAKED)
        bpy.context.scene.collection.objects.unlink(next(o for o in held if o.name == "Post"))
        yield from until(lambda n=names: stale_names() == n, f"without its post: {stale_names()}")
        for scene_object in held:
            bpy.data.objects.remove(scene_object)
        yield from until(lambda: not baked_names(), f"the panel lists {baked_names()}")


def light_up() -> None:
    """A World of one colour in the empty file."""
    world = bpy.data.worlds.new("World")
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.3, 0.5, 0.8, 1.0)
    bpy.context.scene.world = world
    space().shading.type, space().overlay.show_overlays, space().show_gizmo = "SOLID", False, False


def load_and_start_anew() -> Step:
    """Another file with the preview on: drawn at once; a new file: nothing drawn, nothing said."""
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(SAVED), load_ui=False)
    yield from until(lambda: baked_names() == BAKED, f"the panel lists {baked_names()}")
    space().shading.type, space().overlay.show_overlays, space().show_gizmo = "SOLID", False, False
    look()
    yield from check_view("c50_loaded", BAKED)
    with override():
        bpy.ops.wm.read_homefile(use_empty=True, load_ui=False)
    yield from until(lambda: not baked_names(), f"the panel lists {baked_names()}")
    assert not drawn() and not session().viewport_message, session().viewport_message
    yield 1.0
    shoot("c51_new_file")


ALL = (bake_once, move_the_set, move_one, edit_what_counts, rename_and_delete, duplicate, switch_scenes,
       append_and_link, load_and_start_anew)

if __name__ == "__main__":
    assert SCENE
    names = os.environ.get("PRT_STEPS", "").split()
    start(tuple(step for step in ALL if not names or step in ALL[:1] or step.__name__ in names), "changes")
