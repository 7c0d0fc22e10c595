# SPDX-License-Identifier: GPL-3.0-or-later
"""What materials do beyond diffuse reflection, read from their node trees as SurfaceMaterial.

Read are trees whose surface is one Principled, Glossy or Diffuse BSDF. Values that vary over the surface get a
stand-in, and a warning names it: the mean of an image texture, else the value that the socket has without its link.
Every other tree counts as diffuse (its albedo is evaluated by `materials`). Coat, sheen, thin film, transmission and
alpha are left out, and normal maps do not turn the highlight.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np
from numpy.typing import NDArray

from ..scene.surface_material import DIFFUSE, SurfaceMaterial
from .nodes import constant_of, reachable, source_of

Tangent = tuple[str, str]  # ("RADIAL", axis) or ("UV_MAP", name of the map, empty for the one that renders)
DEFAULT_TANGENT: Tangent = ("RADIAL", "Z")  # of Cycles, for a socket Tangent without a link
GLOSSY_NODES = {"ShaderNodeBsdfAnisotropic", "ShaderNodeBsdfGlossy"}
WITH_HIGHLIGHT = {"ShaderNodeBsdfPrincipled", "ShaderNodeBsdfMetallic", "ShaderNodeBsdfGlass",
                  "ShaderNodeSubsurfaceScattering", *GLOSSY_NODES}
LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec.709, for a colour linked to a value
LEAST_REFLECTION = 1e-6  # F0 below it is no highlight
# The share of Schlick's term at the angle at which a metal's edge tint is given (82 degrees, cosine 1/7).
EDGE_SHARE = (6.0 / 7.0) ** 5


@dataclass(frozen=True)
class Surface:
    """A material as numbers, and where its tangent comes from; None where its highlight has no direction."""

    material: SurfaceMaterial
    tangent: Tangent | None = None


PLAIN = Surface(DIFFUSE)


class SurfaceReader:
    """Reads each material once; warnings gets a line per material and input that has a stand-in."""

    def __init__(self, warnings: list[str]) -> None:
        self._warnings = warnings
        self._read: dict[bpy.types.Material | None, Surface] = {None: PLAIN}

    def of(self, material: bpy.types.Material | None) -> Surface:
        """The surface of a material; Cycles' default one of an empty slot is diffuse."""
        if material not in self._read:
            self._read[material] = _Inputs(material, self._warnings).read()
        return self._read[material]


class _Inputs:
    """The inputs of one material's surface node as numbers."""

    def __init__(self, material: bpy.types.Material, warnings: list[str]) -> None:
        self._material, self._warnings = material, warnings
        output = material.node_tree.get_output_node("CYCLES") if material.node_tree is not None else None
        self._output = output
        self._node = source_of(output.inputs["Surface"]) if output is not None else None

    def read(self) -> Surface:
        if self._node is None or self._node.mute:
            return PLAIN
        if self._node.bl_idname == "ShaderNodeBsdfPrincipled":
            return self._principled()
        if self._node.bl_idname in GLOSSY_NODES:
            return self._glossy()
        if any(node.bl_idname in WITH_HIGHLIGHT and not node.mute for node in reachable(self._output)):
            self._warn("only its diffuse part is baked: its surface is not a single Principled or Glossy BSDF")
        return PLAIN

    def _principled(self) -> Surface:
        metallic = self._share("Metallic")
        ior = max(self._value("IOR"), 1e-3)
        ior = max(ior, 1.0 / ior)  # the same reflection from either side
        level = self._share("Specular IOR Level")
        if 2.0 * level * ((ior - 1.0) / (ior + 1.0)) ** 2 < LEAST_REFLECTION:
            level = 0.0
        weight, radius = self._subsurface()
        if level <= 0.0 and metallic <= 0.0 and weight <= 0.0:
            return PLAIN
        anisotropic = self._share("Anisotropic")
        # The Random Walk (Skin) method has an IOR of its own; the others enter through the surface's.
        medium = "Subsurface IOR" if self._node.subsurface_method == "RANDOM_WALK_SKIN" else "IOR"
        material = SurfaceMaterial(
            self._material.name, self._colour("Base Color"), self._share("Roughness"), metallic, ior, level,
            self._colour("Specular Tint"), anisotropic,
            self._value("Anisotropic Rotation") % 1.0 if anisotropic > 0.0 else 0.0, weight, radius,
            max(self._value(medium), 1.0) if weight > 0.0 else 1.4,
            float(np.clip(self._value("Subsurface Anisotropy"), -0.99, 0.99)) if weight > 0.0 else 0.0)
        directed = anisotropic > 0.0 and (level > 0.0 or metallic > 0.0)
        return Surface(material, self._tangent() if directed else None)

    def _subsurface(self) -> tuple[float, tuple[float, float, float]]:
        """Weight, and the mean free path per channel in metres: Cycles does not scale it with the object."""
        weight = self._share("Subsurface Weight")
        if weight <= 0.0:
            return 0.0, (0.0, 0.0, 0.0)
        scale = max(self._value("Subsurface Scale"), 0.0)
        radius = self._numbers("Subsurface Radius")
        return weight, tuple(max(float(r), 0.0) * scale for r in radius[:3])

    def _glossy(self) -> Surface:
        """A Glossy BSDF as a metal whose edge tint makes it reflect the same colour at 82 degrees as head-on.

        Its anisotropy a gives widths alpha (1 - a) along the tangent and alpha / (1 - a) across it; a Principled's b
        alpha / s and alpha s with s = sqrt(1 - 0.9 b). So s = 1 - |a|, and the tangent turns by a quarter where a > 0.
        """
        colour = self._colour("Color")
        edge = tuple(c / max(c + (1.0 - c) * EDGE_SHARE, 1e-6) for c in colour)
        if max(colour) < LEAST_REFLECTION:
            return PLAIN
        anisotropy = float(np.clip(self._value("Anisotropy"), -0.99, 0.99))
        anisotropic = (1.0 - (1.0 - abs(anisotropy)) ** 2) / 0.9
        if anisotropic > 1.0:
            self._warn(f"its anisotropy {anisotropy:.2f} is baked as {np.sign(anisotropy) * (1 - 0.1 ** 0.5):.2f}, "
                       "the most that is stored")
            anisotropic = 1.0
        turn = (self._value("Rotation") + (0.25 if anisotropy > 0.0 else 0.0)) % 1.0 if anisotropic > 0.0 else 0.0
        material = SurfaceMaterial(self._material.name, colour, self._share("Roughness"), 1.0, specular_level=0.0,
                                   specular_tint=edge, anisotropic=anisotropic, anisotropic_rotation=turn)
        return Surface(material, self._tangent() if anisotropic > 0.0 else None)

    def _tangent(self) -> Tangent:
        node = source_of(self._node.inputs["Tangent"])
        if node is None:
            return DEFAULT_TANGENT
        if node.bl_idname == "ShaderNodeTangent" and not node.mute:
            return (("UV_MAP", node.uv_map) if node.direction_type == "UV_MAP" else ("RADIAL", node.axis))
        self._warn("its Tangent is linked to a node that is not read; the default tangent is used")
        return DEFAULT_TANGENT

    def _value(self, name: str) -> float:
        numbers = self._numbers(name)
        return float(numbers[0])

    def _share(self, name: str) -> float:
        return float(np.clip(self._value(name), 0.0, 1.0))

    def _colour(self, name: str) -> tuple[float, float, float]:
        return tuple(float(c) for c in np.clip(self._numbers(name)[:3], 0.0, 1.0))

    def _numbers(self, name: str) -> NDArray[np.float64]:
        """The value of an input, of one number or several; a stand-in with a warning where it varies."""
        socket = self._node.inputs[name]
        value = constant_of(socket)
        if value is not None:
            return np.nan_to_num(np.atleast_1d(np.asarray(value, np.float64)))
        node = source_of(socket)
        image = getattr(node, "image", None) if node.bl_idname == "ShaderNodeTexImage" and not node.mute else None
        mean = None if image is None else mean_of_image(image)
        if mean is not None:
            self._warn(f"{name} varies; the mean of image {image.name} stands in")
            return mean if socket.type == "RGBA" else np.atleast_1d(np.sum(mean * LUMINANCE))
        value = socket.default_value
        plain = np.atleast_1d(np.asarray(value if isinstance(value, (float, int)) else tuple(value), np.float64))
        self._warn(f"{name} varies; its unlinked value {', '.join(f'{v:.3g}' for v in plain[:3])} stands in")
        return plain

    def _warn(self, what: str) -> None:
        line = f"Material {self._material.name}: {what}"
        if line not in self._warnings:
            self._warnings.append(line)


def mean_of_image(image: bpy.types.Image) -> NDArray[np.float64] | None:
    """Mean colour (3,) of an image, linear as Cycles sees it; None where it has no pixels."""
    width, height = image.size
    if width * height == 0 or image.channels == 0:
        return None
    pixels = np.empty(width * height * image.channels, np.float32)
    image.pixels.foreach_get(pixels)
    colours = pixels.reshape(-1, image.channels)[:, :3]
    if not image.is_float and image.colorspace_settings.name == "sRGB":  # float images are held scene-linear
        colours = np.where(colours <= 0.04045, colours / 12.92, ((np.maximum(colours, 0.0) + 0.055) / 1.055) ** 2.4)
    mean = np.nan_to_num(colours.mean(axis=0, dtype=np.float64))
    return np.repeat(mean[:1], 3) if len(mean) < 3 else mean
