# SPDX-License-Identifier: GPL-3.0-or-later
"""The lighting of a scene as plain values, and back: the World, and each light with its place, shape, colour, switches.

A state is a dictionary of JSON's kinds alone; floats come back to the bit. Writing touches what the state names and
nothing else, and only values that differ. What can't be written is said in one line each; the rest is applied.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import bpy
from bpy_extras.anim_utils import action_get_channelbag_for_slot

from .nodes import origin_of, path_of, reachable

State = dict[str, Any]
SCHEMA = 1
TAKES_OVER = "{}: it is animated: key it, or its keyframes take over at the next frame"
SWITCHES = ("hide_viewport", "hide_render")
ROTATIONS = {"QUATERNION": "rotation_quaternion", "AXIS_ANGLE": "rotation_axis_angle"}
PLACE = ("location", "rotation_mode", "rotation_euler", "rotation_quaternion", "rotation_axis_angle", "scale")
# The kind comes first: it decides which of the others a light has.
COLOURS = ("color", "energy", "exposure", "use_temperature", "temperature", "normalize")
SHAPES = {"POINT": ("shadow_soft_size", "use_soft_falloff"),
          "SPOT": ("shadow_soft_size", "use_soft_falloff", "spot_size", "spot_blend"),
          "SUN": ("angle",), "AREA": ("shape", "size", "size_y", "spread")}
INPUTS = {"ShaderNodeBackground": ("Color", "Strength"), "ShaderNodeEmission": ("Color", "Strength"),
          "ShaderNodeMapping": ("Rotation",)}
OUTPUTS = {"ShaderNodeValue": (0,), "ShaderNodeRGB": (0,)}
SETTINGS = {"ShaderNodeTexSky": ("sun_elevation", "sun_rotation", "sun_size", "sun_intensity", "sun_disc", "altitude",
                                 "air_density", "aerosol_density", "dust_density", "ozone_density")}


def lights_of(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The scene's lights, in the file's order."""
    return [found for found in scene.objects if found.type == "LIGHT"]


def read_lighting(scene: bpy.types.Scene) -> State:
    """The lighting as it is set now: {schema, world: None or {name, color | nodes}, lights: {object: {...}}}.

    Per light: `light` (the name of its data), `data` and `object` (values by property), `nodes` where it has any.
    """
    world = scene.world
    return {"schema": SCHEMA, "world": None if world is None else _read_world(world),
            "lights": {found.name_full: _read_light(found) for found in lights_of(scene)}}


def shown_worlds_images(scene: bpy.types.Scene) -> list[bpy.types.Image]:
    """Images that a state of now names."""
    world = scene.world
    nodes = _nodes(world.node_tree) if world is not None and world.node_tree is not None else ()
    return [n.image for n in nodes if n.bl_idname == "ShaderNodeTexEnvironment" and n.image is not None]


def write_lighting(scene: bpy.types.Scene, state: State, world: bpy.types.World | None = None,
                   images: Mapping[str, bpy.types.Image] | None = None) -> list[str]:
    """Set the lighting as it was when `state` was read; lines for the user about what could not be, or will not stay.

    world, images: the data-blocks themselves (images by the name they had then), for they may have been renamed.
    """
    notes: list[str] = []
    _write_world(scene, state["world"], world, images or {}, notes)
    by_name = {found.name_full: found for found in lights_of(scene)}
    written: dict[str, tuple[str, State]] = {}
    for name, values in state["lights"].items():
        if name not in by_name:
            notes.append(f"{name}: there is no light of this name any more")
            continue
        _write_light(by_name[name], values, written, notes)
    return list(dict.fromkeys(notes))


def set_light(light: bpy.types.Object, is_on: bool, notes: list[str]) -> None:
    """Switch one light on or off, in viewports and renders."""
    _assign(light, light, dict.fromkeys(SWITCHES, not is_on), light.name, notes)


def is_on(light: bpy.types.Object) -> bool:
    """Whether renders, and so the preview, show the light."""
    return not light.hide_render


def strengths(world: bpy.types.World | None) -> list[bpy.types.NodeSocket]:
    """Sockets that hold the strengths of a World's Backgrounds, of those that nodes don't compute."""
    found = []
    for node in _nodes(world.node_tree) if world is not None and world.node_tree is not None else ():
        if node.bl_idname == "ShaderNodeBackground":
            socket = _holder(node.inputs["Strength"])
            if socket is not None and socket not in found:
                found.append(socket)
    return found


def animated_sockets(world: bpy.types.World) -> list[bpy.types.NodeSocket]:
    """Sockets of a World that can be keyed: strengths, colours, rotations and the values that feed them."""
    return [socket for node in _nodes(world.node_tree) if world.node_tree is not None
            for socket in _sockets(node).values()] if world.node_tree is not None else []


def sky_settings(world: bpy.types.World) -> list[tuple[bpy.types.Node, str]]:
    """Sky textures and their settings that can be keyed."""
    nodes = _nodes(world.node_tree) if world.node_tree is not None else ()
    return [(node, name) for node in nodes for name in SETTINGS.get(node.bl_idname, ())
            if node.bl_rna.properties.get(name) is not None and node.bl_rna.properties[name].type == "FLOAT"]


def node_named(world: bpy.types.World | None, kind: str) -> str:
    """The first node of a kind that the World shows; an empty text for none. For panels."""
    nodes = _nodes(world.node_tree) if world is not None and world.node_tree is not None else ()
    return next((node.name for node in nodes if node.bl_idname == kind), "")


def read_nodes(tree: bpy.types.NodeTree | None) -> State:
    """By name of the node: the values of it that light depends on; nodes inside of groups are left alone."""
    found: State = {}
    for node in _nodes(tree) if tree is not None else ():
        values: State = {"sockets": {key: plain(socket.default_value) for key, socket in _sockets(node).items()},
                         "settings": {name: plain(getattr(node, name)) for name in SETTINGS.get(node.bl_idname, ())
                                      if hasattr(node, name)}}
        if node.bl_idname == "ShaderNodeTexEnvironment" and node.image is not None:
            values["image"] = {"name": node.image.name_full, "path": path_of(node.image)}
        values = {key: value for key, value in values.items() if value}
        if values:
            found[node.name] = values
    return found


def write_nodes(owner: bpy.types.ID, tree: bpy.types.NodeTree | None, state: State,
                images: Mapping[str, bpy.types.Image], notes: list[str]) -> None:
    """Values of nodes back into a tree of `owner`, whose name the notes bear."""
    subject = owner.name
    for name, values in state.items():
        node = tree.nodes.get(name) if tree is not None else None
        if node is None:
            notes.append(f"{subject}: its node {name} is gone")
            continue
        _assign(owner, node, values.get("settings", {}), subject, notes)
        sockets = _sockets(node)
        for key, value in values.get("sockets", {}).items():
            if key in sockets:
                _assign(owner, sockets[key], {"default_value": value}, subject, notes, tree)
            else:
                notes.append(f"{subject}: {node.name} is fed by other nodes now, so its value stays")
        if "image" in values and node.bl_idname == "ShaderNodeTexEnvironment":
            _write_image(owner, node, values["image"], images, notes)


def plain(value: Any) -> Any:
    """A property's value as JSON has it."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return [float(v) for v in value]


def _read_world(world: bpy.types.World) -> State:
    state: State = {"name": world.name_full}
    if world.node_tree is None:
        return {**state, "color": plain(world.color)}
    return {**state, "nodes": read_nodes(world.node_tree)}


def _read_light(found: bpy.types.Object) -> State:
    data = found.data
    names = ("type", *COLOURS, *SHAPES[data.type])
    state: State = {"light": data.name_full, "data": {name: plain(getattr(data, name)) for name in names},
                    "object": {name: plain(getattr(found, name)) for name in (*SWITCHES, *PLACE)}}
    nodes = read_nodes(data.node_tree)
    return {**state, "nodes": nodes} if nodes else state


def _write_world(scene: bpy.types.Scene, state: State | None, world: bpy.types.World | None,
                 images: Mapping[str, bpy.types.Image], notes: list[str]) -> None:
    if state is not None and world is None:
        world = next((w for w in bpy.data.worlds if w.name_full == state["name"]), None)
        if world is None:
            notes.append(f"World {state['name']}: it is gone, so the present one stays")
            return
    if state is None:
        world = None
    if scene.world != world:
        if not scene.is_editable:
            notes.append(f"scene {scene.name}: linked from another file, so its World stays")
            return
        scene.world = world
    if state is None:
        return
    if "color" in state:
        _assign(world, world, {"color": state["color"]}, world.name, notes)
    if state.get("nodes"):
        write_nodes(world, world.node_tree, state["nodes"], images, notes)


def _write_image(owner: bpy.types.ID, node: bpy.types.Node, told: State, images: Mapping[str, bpy.types.Image],
                 notes: list[str]) -> None:
    """The image that a node showed: the data-block, else one of its name, else its file."""
    image = images.get(told["name"]) or next((i for i in bpy.data.images if i.name_full == told["name"]), None)
    if image is None and told["path"]:
        try:
            image = bpy.data.images.load(told["path"], check_existing=True)
        except RuntimeError:
            image = None
    if image is None:
        notes.append(f"{owner.name}: its image {told['name']} is gone, so the present one stays")
    elif node.image != image:
        if owner.is_editable:
            node.image = image
        else:
            notes.append(_linked(owner.name))


def _write_light(found: bpy.types.Object, state: State, written: dict[str, tuple[str, State]],
                 notes: list[str]) -> None:
    """One light; `written` keeps whose values each data got, since several lights may have come to share it."""
    _assign(found, found, state["object"], found.name, notes)
    data = found.data
    wanted = {"data": state["data"], "nodes": state.get("nodes", {})}
    other, before = written.setdefault(data.name_full, (found.name, wanted))
    if before != wanted:
        notes.append(f"{found.name}: it shares its light with {other} now, whose values both get")
        return
    _assign(data, data, {"type": state["data"]["type"]}, found.name, notes)
    data = found.data  # of its new kind
    _assign(data, data, {name: value for name, value in state["data"].items() if hasattr(data, name)}, found.name,
            notes)
    if state.get("nodes"):
        write_nodes(data, data.node_tree, state["nodes"], {}, notes)


def _assign(owner: bpy.types.ID, holder: bpy.types.bpy_struct, values: State, subject: str, notes: list[str],
            animated: bpy.types.ID | None = None) -> None:
    """Set values that differ; a linked owner, and values that keyframes or drivers hold, are noted.

    animated: the ID whose animation would hold them, where it is not the owner: a node tree has its own.
    """
    changed = {name: value for name, value in values.items() if plain(getattr(holder, name)) != value}
    if not changed:
        return
    if not owner.is_editable:
        notes.append(_linked(subject))
        return
    for name, value in changed.items():
        setattr(holder, name, value)
    if isinstance(holder, bpy.types.Node):
        animated = holder.id_data
    keyed = animated_paths(animated or owner)
    if keyed and any(holder.path_from_id(name) in keyed for name in changed):
        notes.append(TAKES_OVER.format(subject))


def _linked(subject: str) -> str:
    return f"{subject}: linked from another file, so it stays as it is"


def animated_paths(owner: bpy.types.ID) -> set[str]:
    """Paths of an ID's properties that keyframes or drivers hold."""
    animation = owner.animation_data
    if animation is None:
        return set()
    paths = {curve.data_path for curve in animation.drivers}
    if animation.action is not None and animation.action_slot is not None:
        bag = action_get_channelbag_for_slot(animation.action, animation.action_slot)
        paths |= {curve.data_path for curve in bag.fcurves} if bag is not None else set()
    return paths


def _nodes(tree: bpy.types.NodeTree) -> Iterator[bpy.types.Node]:
    """Nodes of the tree itself that its output depends on, in the tree's order."""
    output = tree.get_output_node("CYCLES")
    shown = {node.as_pointer() for node in reachable(output)} if output is not None else set()
    return (node for node in tree.nodes if node.as_pointer() in shown)


def _holder(socket: bpy.types.NodeSocket) -> bpy.types.NodeSocket | None:
    """Where the value of an input is set: itself, or the Value or RGB node that feeds it; None where it is computed."""
    output, place, groups = origin_of(socket, ())
    if output is None:
        return socket if place == socket else None
    return output if output.node.bl_idname in OUTPUTS and not groups else None


def _sockets(node: bpy.types.Node) -> dict[str, bpy.types.NodeSocket]:
    """By a name that stays: the sockets of a node whose values light depends on and that are not fed by others."""
    inputs = {f"in {name}": node.inputs[name] for name in INPUTS.get(node.bl_idname, ())}
    free = {key: socket for key, socket in inputs.items() if not socket.is_linked}
    return free | {f"out {index}": node.outputs[index] for index in OUTPUTS.get(node.bl_idname, ())}
