# SPDX-License-Identifier: GPL-3.0-or-later
"""Reading node trees: what a socket is fed by, and a signature that changes when anything in the tree does."""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable, Iterator

import bpy

# Where a node sits and how it is labelled says nothing about light; the rest of these would recurse endlessly.
IGNORED = {"rna_type", "location", "location_absolute", "width", "height", "label", "select", "hide", "show_options",
           "show_preview", "show_texture", "parent", "dimensions", "color", "use_custom_color", "color_tag", "inputs",
           "outputs", "internal_links", "warning_propagation", "bl_idname", "bl_label", "bl_description", "bl_icon",
           "bl_static_type", "bl_width_default", "bl_width_min", "bl_width_max", "bl_height_default",
           "bl_height_min", "bl_height_max", "is_active_output", "is_active_preview", "name", "image_user_frame"}
PLAIN = {"BOOLEAN", "INT", "FLOAT", "STRING", "ENUM"}


Groups = tuple[bpy.types.Node, ...]  # the group nodes that a socket lies in, the outermost first


def origin_of(socket: bpy.types.NodeSocket, groups: Groups | None = (),
              ) -> tuple[bpy.types.NodeSocket | None, bpy.types.NodeSocket, Groups | None]:
    """What feeds an input socket, past reroutes and through the walls of node groups.

    Gives the output socket (None where nothing feeds it), the input socket that it (or else the value) was found at,
    and the groups that one lies in. A muted link counts as none, as in Cycles. A muted group is given as it is, and
    with groups None so is every other.
    """
    while socket.is_linked:
        link = socket.links[0]
        if link.is_muted or not link.is_valid:
            return None, socket, groups
        node, output = link.from_node, link.from_socket
        if node.bl_idname == "NodeReroute":
            socket = node.inputs[0]
        elif node.bl_idname == "NodeGroupInput" and groups:
            found = _same_socket(groups[-1].inputs, output.identifier)
            if found is None:
                return output, socket, groups
            socket, groups = found, groups[:-1]
        elif node.bl_idname == "ShaderNodeGroup" and groups is not None and node.node_tree and not node.mute:
            results = (n for n in node.node_tree.nodes if n.bl_idname == "NodeGroupOutput" and n.is_active_output)
            inner = next(results, None)
            found = None if inner is None else _same_socket(inner.inputs, output.identifier)
            if found is None:
                return output, socket, groups
            socket, groups = found, (*groups, node)
        else:
            return output, socket, groups
    return None, socket, groups


def _same_socket(sockets: bpy.types.NodeInputs, identifier: str) -> bpy.types.NodeSocket | None:
    return next((socket for socket in sockets if socket.identifier == identifier), None)


def source_of(socket: bpy.types.NodeSocket, groups: Groups | None = None) -> bpy.types.Node | None:
    """The node that feeds an input socket, see `origin_of`; None where nothing does."""
    output = origin_of(socket, groups)[0]
    return None if output is None else output.node


def constant_of(socket: bpy.types.NodeSocket, groups: Groups | None = None) -> tuple[float, ...] | float | None:
    """The value of a socket that is unlinked or fed by a plain Colour or Value node; None where it varies."""
    output, place, _ = origin_of(socket, groups)
    kind = socket.type
    if output is None:
        if not hasattr(place, "default_value") or (place.type == "RGBA") != (kind == "RGBA"):
            return None  # a colour that a group takes as a number or the other way round
        value = place.default_value
    elif output.node.mute:
        return None
    elif output.node.bl_idname in {"ShaderNodeRGB", "ShaderNodeValue"}:
        same_kind = (output.node.bl_idname == "ShaderNodeRGB") == (kind == "RGBA")
        if not same_kind:
            return None
        value = output.node.outputs[0].default_value
    else:
        return None
    return float(value) if isinstance(value, (float, int)) else tuple(float(v) for v in value)


def walk(tree: bpy.types.NodeTree, seen: set[int] | None = None) -> Iterator[bpy.types.NodeTree]:
    """The tree and every group nested in it, each once."""
    seen = set() if seen is None else seen
    if tree.as_pointer() in seen:
        return
    seen.add(tree.as_pointer())
    yield tree
    for node in tree.nodes:
        if isinstance(getattr(node, "node_tree", None), bpy.types.NodeTree):
            yield from walk(node.node_tree, seen)


def copy_groups(tree: bpy.types.NodeTree, change: Callable[[bpy.types.NodeTree], None],
                copies: list[bpy.types.NodeTree]) -> None:
    """Apply `change` to a tree of ours and to own copies of all groups nested in it; `copies` collects the copies."""
    change(tree)
    for node in tree.nodes:
        if isinstance(getattr(node, "node_tree", None), bpy.types.NodeTree):
            node.node_tree = node.node_tree.copy()
            copies.append(node.node_tree)
            copy_groups(node.node_tree, change, copies)


def signature(tree: bpy.types.NodeTree, edits: bool = True, without: frozenset[str] = frozenset()) -> Hashable:
    """Hashable value that changes when nodes, values, links, images (by file) or groups of the tree change; with edits
    also when an image is painted on for the first time since it was saved. without: names of inputs whose values do not
    count."""
    return tuple((tuple(_node_signature(node, edits, without) for node in part.nodes),
                  tuple((link.from_node.name, link.from_socket.identifier, link.to_node.name,
                         link.to_socket.identifier, link.is_muted) for link in part.links)) for part in walk(tree))


def _node_signature(node: bpy.types.Node, edits: bool, without: frozenset[str]) -> Hashable:
    inputs = tuple(_value(s.default_value) for s in node.inputs
                   if hasattr(s, "default_value") and s.name not in without)
    outputs = tuple(_value(s.default_value) for s in node.outputs if hasattr(s, "default_value"))
    return node.bl_idname, node.name, inputs, outputs, _struct_signature(node, 0, edits)


def _struct_signature(struct: bpy.types.bpy_struct, depth: int, edits: bool) -> Hashable:
    """Values of a struct's properties; of data-blocks only their identity, of nested settings their values."""
    if isinstance(struct, bpy.types.Image):
        return (struct.name_full, struct.filepath, tuple(struct.size), struct.colorspace_settings.name, struct.source,
                struct.alpha_mode, edits and struct.is_dirty)
    if isinstance(struct, bpy.types.ID):
        return struct.name_full
    parts = []
    for item in struct.bl_rna.properties:
        if item.identifier in IGNORED or (item.is_hidden and item.type not in PLAIN):
            continue
        value = getattr(struct, item.identifier)
        if item.type in PLAIN:
            parts.append((item.identifier, _value(value)))
        elif item.type == "POINTER" and value is not None and depth < 3:
            parts.append((item.identifier, _struct_signature(value, depth + 1, edits)))
        elif item.type == "COLLECTION" and depth < 3:
            parts.append((item.identifier, tuple(_struct_signature(v, depth + 1, edits) for v in value)))
    return tuple(parts)


def _value(value: object) -> Hashable:
    """A property's value as something hashable with a stable text."""
    if isinstance(value, bpy.types.bpy_struct):
        return value.name_full if isinstance(value, bpy.types.ID) else type(value).__name__
    if isinstance(value, (set, frozenset)):
        return tuple(sorted(value))
    if value is None or isinstance(value, (str, int, float, bool)):
        return value
    return tuple(_value(v) for v in value)


def reachable(output: bpy.types.Node) -> Iterator[bpy.types.Node]:
    """Every node that a tree's output depends on, groups opened whole."""
    pending, seen = [output], set()
    while pending:
        node = pending.pop()
        if node.as_pointer() in seen:
            continue
        seen.add(node.as_pointer())
        yield node
        pending.extend(link.from_node for socket in node.inputs for link in socket.links if not link.is_muted)
        if isinstance(getattr(node, "node_tree", None), bpy.types.NodeTree):
            for part in walk(node.node_tree):
                yield from part.nodes


def shown_images(output: bpy.types.Node) -> list[bpy.types.Image]:
    """Images that an output node shows, in a stable order."""
    found = [node.image for node in reachable(output) if isinstance(getattr(node, "image", None), bpy.types.Image)]
    return list(dict.fromkeys(found))


def path_of(image: bpy.types.Image) -> str:
    """The image's file, or an empty text."""
    return os.path.normpath(bpy.path.abspath(image.filepath, library=image.library)) if image.filepath else ""
