# SPDX-License-Identifier: GPL-3.0-or-later
"""The World as the artist built it: plain colours and HDRIs are read, every other node tree is evaluated by Cycles."""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, field, replace

import bpy
import numpy as np
from numpy.typing import NDArray

from ..errors import BadScene, PRTError
from ..lighting.cubemap_light import EnvironmentTexels
from ..lighting.environment import band_energies, check_finite, load_equirectangular, project, total_energy
from ..lighting.reference_light import reference_image
from .nodes import constant_of, path_of, reachable, shown_images, signature, source_of
from .world_render import render_world

HIGHEST_ORDER = 10
CACHED = 8  # projected environments kept: some kilobytes each
LINEAR = {"Linear Rec.709", "Non-Color"}
CHOOSE_IMAGE = "Put it back, or choose another image in the World"
IDENTITY = np.eye(3)
STRONGEST = 1e30  # products with transfer still fit single precision


@dataclass(frozen=True)
class ProjectedImage:
    """What is kept of an equirectangular image: coefficients (100, 3) at the highest order, its total energy (integral
    of squared radiance, channels summed), and the image averaged to the width of references. Cubemaps are made of the
    image itself, read again by `make`, and kept in `cubemaps` by their size."""

    coefficients: NDArray[np.float64]
    energy: float
    small: NDArray[np.float32]
    make: Callable[[], NDArray[np.float32]]
    cubemaps: dict[int, EnvironmentTexels] = field(default_factory=dict)

    @staticmethod
    def of(make: Callable[[], NDArray[np.float32]]) -> ProjectedImage:
        """Project an image (height, width, 3), linear, top row first."""
        image = make()
        return ProjectedImage(project(image, HIGHEST_ORDER), total_energy(image), reference_image(image),
                              make)

    def texels(self, size: int) -> EnvironmentTexels:
        """Mean radiance in the texels of a cubemap, to be turned."""
        if size not in self.cubemaps:
            self.cubemaps[size] = EnvironmentTexels.of(self.make(), size)
        return self.cubemaps[size]

    def truncation(self, order: int) -> float:
        """Share of the energy, 0..1, that the first `order` bands do not hold."""
        if self.energy <= 0.0:
            return 0.0
        held = float(band_energies(self.coefficients[:order * order]).sum())
        return min(max(1.0 - held / self.energy, 0.0), 1.0)


@dataclass(frozen=True)
class EnvironmentSource:
    """The light that comes from everywhere: `projected`, times scale (3,), turned by rotation (3, 3).

    kind: "none", "colour", "image" (read from its file) or "nodes" (evaluated by Cycles).
    """

    name: str
    kind: str
    projected: ProjectedImage
    scale: NDArray[np.float64] = field(default_factory=lambda: np.ones(3))
    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    warnings: tuple[str, ...] = ()

    @property
    def is_black(self) -> bool:
        """Whether it gives no light at all."""
        return not (self.projected.energy > 0.0 and np.any(self.scale != 0.0))


_cache: dict[Hashable, ProjectedImage] = {}


def read_environment(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph,
                     use_fast_paths: bool = True) -> EnvironmentSource:
    """The World's light on diffuse surfaces. Cheap while nothing but rotation, strength or colour changes.

    use_fast_paths: False evaluates every World with Cycles (for tests). Raises PRTError naming the image where a file
    is missing or holds values that are not finite.
    """
    world = scene.world
    if world is None:
        return _plain("no World", "none", np.zeros(3), ("the scene has no World: it gives no light",))
    if not world.cycles_visibility.diffuse:
        return _plain(world.name, "none", np.zeros(3),
                      (f"World {world.name}: its ray visibility for diffuse is off, so it gives no light",))
    if world.node_tree is None:
        return _coloured(world, tuple(world.color))
    output = world.node_tree.get_output_node("CYCLES")
    surface = source_of(output.inputs["Surface"]) if output is not None else None
    if surface is None:
        return _coloured(world, (0.0, 0.0, 0.0))
    _check_images(world, output)
    found = _fast(world, surface) if use_fast_paths else None
    return found if found is not None else _by_cycles(scene, world, output)


def needs_cycles(scene: bpy.types.Scene) -> bool:
    """Whether `read_environment` would have Cycles evaluate the World's nodes, which can't be done within a render."""
    world = scene.world
    if world is None or world.node_tree is None or not world.cycles_visibility.diffuse:
        return False
    output = world.node_tree.get_output_node("CYCLES")
    surface = source_of(output.inputs["Surface"]) if output is not None else None
    if surface is None or surface.bl_idname != "ShaderNodeBackground" or surface.mute:
        return surface is not None
    if constant_of(surface.inputs["Strength"]) is None:
        return True
    if constant_of(surface.inputs["Color"]) is not None:
        return False
    texture = source_of(surface.inputs["Color"])
    return not _is_plain_hdri(texture) or _lookup_rotation(texture) is None


def read_environment_file(path: str) -> EnvironmentSource:
    """An equirectangular .exr or .hdr file in place of the World. Raises PRTError naming the file."""
    path = os.fspath(path)
    time = os.stat(path).st_mtime_ns if os.path.isfile(path) else None
    projected = _projected(("file", os.path.abspath(path), time), lambda: load_equirectangular(path))
    return EnvironmentSource(os.path.basename(path), "image", projected)


def _plain(name: str, kind: str, colour: NDArray[np.float64], warnings: tuple[str, ...] = ()) -> EnvironmentSource:
    """The same radiance from everywhere."""
    white = _projected("white", lambda: np.ones((32, 64, 3), np.float32))
    return EnvironmentSource(name, kind, white, colour, warnings=warnings)


def check_strength(subject: str, values: Iterable[float]) -> None:
    """Raise BadScene where a light's colours or strength are no numbers to reckon with in single precision."""
    if not all(abs(value) <= STRONGEST for value in values):  # also catches NaN
        raise BadScene(subject, f"its colour or strength is not a number below {STRONGEST:.0e}", "Lower its strength")


def _coloured(world: bpy.types.World, colour: tuple[float, ...]) -> EnvironmentSource:
    check_strength(f"World {world.name}", colour)
    black = not any(colour)
    warnings = (f"World {world.name}: it is black and gives no light",) if black else ()
    return _plain(world.name, "none" if black else "colour", np.array(colour[:3], np.float64), warnings)


def _fast(world: bpy.types.World, surface: bpy.types.Node) -> EnvironmentSource | None:
    """A Background node with constant strength and a constant colour or an HDRI; None for everything else."""
    if surface.bl_idname != "ShaderNodeBackground" or surface.mute:
        return None
    strength, colour = constant_of(surface.inputs["Strength"]), constant_of(surface.inputs["Color"])
    if strength is None:
        return None
    if colour is not None:
        return _coloured(world, tuple(strength * c for c in colour[:3]))
    check_strength(f"World {world.name}", (strength,))
    texture = source_of(surface.inputs["Color"])
    rotation = _lookup_rotation(texture) if _is_plain_hdri(texture) else None
    if rotation is None:
        return None
    image = texture.image
    projected = _projected(_image_key(image), lambda: _image_pixels(image))
    # The node turns the direction that is looked up, so the picture turns the other way (lighting/environment.py).
    return EnvironmentSource(f"{world.name}: {image.name}", "image", projected, np.full(3, strength), rotation.T)


def _is_plain_hdri(node: bpy.types.Node | None) -> bool:
    """An equirectangular linear float image whose pixels Blender holds as Cycles sees them."""
    if node is None or node.bl_idname != "ShaderNodeTexEnvironment" or node.mute or node.image is None:
        return False
    mapping, colours, image = node.texture_mapping, node.color_mapping, node.image
    untouched = (mapping.mapping == "FLAT" and tuple(mapping.translation) == (0, 0, 0)
                 and tuple(mapping.rotation) == (0, 0, 0) and tuple(mapping.scale) == (1, 1, 1)
                 and not (mapping.use_min or mapping.use_max)
                 and (mapping.mapping_x, mapping.mapping_y, mapping.mapping_z) == ("X", "Y", "Z")
                 and not colours.use_color_ramp and colours.blend_factor == 0.0
                 and (colours.brightness, colours.contrast, colours.saturation) == (1, 1, 1))
    return (untouched and node.projection == "EQUIRECTANGULAR" and image.source in {"FILE", "GENERATED"}
            and image.is_float and image.colorspace_settings.name in LINEAR)


def _lookup_rotation(texture: bpy.types.Node) -> NDArray[np.float64] | None:
    """The rotation (3, 3) of the direction that an Environment Texture looks up; None if it is more than a rotation."""
    node = source_of(texture.inputs["Vector"])
    if node is None:
        return None if texture.inputs["Vector"].is_linked else IDENTITY
    if _is_generated(texture.inputs["Vector"]):
        return IDENTITY
    if node.bl_idname != "ShaderNodeMapping" or node.mute or node.vector_type not in {"POINT", "VECTOR"}:
        return None
    if not _is_generated(node.inputs["Vector"]):
        return None
    rotation, scale = constant_of(node.inputs["Rotation"]), constant_of(node.inputs["Scale"])
    location = constant_of(node.inputs["Location"]) if node.vector_type == "POINT" else (0.0, 0.0, 0.0)
    if rotation is None or scale != (1.0, 1.0, 1.0) or location != (0.0, 0.0, 0.0):
        return None
    return _euler_matrix(*rotation)


def _is_generated(socket: bpy.types.NodeSocket) -> bool:
    """Whether a socket is fed by the world's own direction."""
    node = source_of(socket)
    if node is None or node.bl_idname != "ShaderNodeTexCoord" or node.mute:
        return False
    while socket.links[0].from_node != node:
        socket = socket.links[0].from_node.inputs[0]
    return socket.links[0].from_socket.name == "Generated"


def _euler_matrix(x: float, y: float, z: float) -> NDArray[np.float64]:
    """Rotation about X, then Y, then Z, as Blender's Mapping node has it."""
    (cx, cy, cz), (sx, sy, sz) = np.cos([x, y, z]), np.sin([x, y, z])
    return np.array([[cy * cz, sy * sx * cz - cx * sz, sy * cx * cz + sx * sz],
                     [cy * sz, sy * sx * sz + cx * cz, sy * cx * sz - sx * cz],
                     [-sy, cy * sx, cy * cx]])


def _check_images(world: bpy.types.World, output: bpy.types.Node) -> None:
    """Raise PRTError where Cycles would quietly show magenta: a missing file, or an HDRI node without an image."""
    for node in reachable(output):
        if node.bl_idname == "ShaderNodeTexEnvironment" and not node.mute and node.image is None:
            raise PRTError(f"World {world.name}", "its Environment Texture has no image",
                           "Choose an image, or remove the node")
    for image in shown_images(output):
        if image.source == "FILE" and image.packed_file is None and not os.path.isfile(path_of(image)):
            raise PRTError(path_of(image) or image.name, f"the image of World {world.name} does not exist",
                           CHOOSE_IMAGE)
        if image.source == "FILE" and 0 in tuple(image.size):
            raise PRTError(path_of(image) or image.name, f"Blender can't read the image of World {world.name}",
                           CHOOSE_IMAGE)


def _image_key(image: bpy.types.Image) -> Hashable:
    """Identifies an image's content; None where only its pixels could."""
    if image.is_dirty or image.source != "FILE":
        return None
    if image.packed_file is not None:
        return "packed", image.name_full, image.packed_file.size, image.session_uid
    path = path_of(image)
    return "file", path, os.stat(path).st_mtime_ns, image.colorspace_settings.name, image.alpha_mode


def _image_pixels(image: bpy.types.Image) -> NDArray[np.float32]:
    """(height, width, 3) float32 linear, top row first. Raises PRTError for values that are not finite."""
    width, height = image.size
    pixels = np.empty(width * height * image.channels, np.float32)
    image.pixels.foreach_get(pixels)
    pixels = pixels.reshape(height, width, image.channels)[::-1, :, :3]
    colours = np.repeat(pixels[..., :1], 3, axis=2) if pixels.shape[2] < 3 else pixels
    check_finite(colours, path_of(image) or image.name)
    return colours


def _by_cycles(scene: bpy.types.Scene, world: bpy.types.World, output: bpy.types.Node) -> EnvironmentSource:
    """Any other World, evaluated; cached by all values of its nodes."""
    images = shown_images(output)
    keys = [_image_key(image) if image.source in {"FILE", "GENERATED"} else ("frame", image.name_full)
            for image in images]
    cacheable = not any(key is None for key in keys)
    key = ("nodes", signature(world.node_tree), scene.frame_current, tuple(keys)) if cacheable else None
    width = max((image.size[0] for image in images), default=0)
    projected = _projected(key, lambda: _checked_render(scene, world, width))
    warnings = ()
    if projected.energy <= 0.0:
        warnings = (f"World {world.name}: it is black and gives no light",)
    return EnvironmentSource(world.name, "nodes", projected, warnings=warnings)


def _checked_render(scene: bpy.types.Scene, world: bpy.types.World, width: int) -> NDArray[np.float32]:
    image = render_world(scene, world, width)
    check_finite(image, f"World {world.name}")
    return image


def _projected(key: Hashable, make: Callable[[], NDArray[np.float32]]) -> ProjectedImage:
    """`ProjectedImage.of(make)`, kept under the key; a key of None is not kept."""
    if key is None:
        return ProjectedImage.of(make)
    if key not in _cache:
        found = ProjectedImage.of(make)
        while len(_cache) >= CACHED:
            del _cache[next(iter(_cache))]
        _cache[key] = found
    return replace(_cache[key], make=make)  # what it was first read from may be gone
