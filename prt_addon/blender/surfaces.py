# SPDX-License-Identifier: GPL-3.0-or-later
"""What materials do beyond diffuse reflection, read from their node trees as SurfaceMaterial.

Read are trees whose surface is a Principled, Metallic, Glossy or Diffuse BSDF, in node groups too, or a Mix Shader of
such. Values that vary over the surface get a stand-in, and a warning names it: the mean of an image texture, else the
value that the socket has without its link. Every other tree counts as diffuse (its albedo is evaluated by `materials`),
and where that would be black, `stand_in_of` says what colour is drawn instead. Coat, sheen, thin film, transmission and
alpha are left out, and normal maps do not turn the highlight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import bpy
import numpy as np
from numpy.typing import NDArray

from ..scene.surface_material import DIFFUSE, SurfaceMaterial
from .nodes import Groups, constant_of, origin_of, reachable, source_of

Tangent = tuple[str, str]  # ("RADIAL", axis) or ("UV_MAP", name of the map, empty for the one that renders)
DEFAULT_TANGENT: Tangent = ("RADIAL", "Z")  # of Cycles, for a socket Tangent without a link
GLOSSY_NODES = {"ShaderNodeBsdfAnisotropic", "ShaderNodeBsdfGlossy"}
WITH_HIGHLIGHT = {"ShaderNodeBsdfPrincipled", "ShaderNodeBsdfMetallic", "ShaderNodeBsdfGlass",
                  "ShaderNodeSubsurfaceScattering", *GLOSSY_NODES}
# They show what lies behind, or shine: a surface mixed with them keeps its own reflection.
WITHOUT_SURFACE = {"ShaderNodeBsdfTransparent", "ShaderNodeEmission", "ShaderNodeHoldout"}
CLEAR = {"ShaderNodeBsdfRefraction"}  # they transmit without a highlight
LEFT_OUT = ("Coat Weight", "Sheen Weight", "Transmission Weight", "Thin Film Thickness")
REMEDY = "use a Principled BSDF, or a Mix Shader of two"
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


def stand_in_of(material: bpy.types.Material | None) -> tuple[tuple[float, float, float], str] | None:
    """A colour for a material whose diffuse part is black though it reflects or transmits, and a clause that names the
    node and the remedy; None where its highlight is baked, or where nothing reflects."""
    if material is None or material.node_tree is None:
        return None
    inputs = _Inputs(material, [])
    node = inputs.node
    if node is None or node.mute or node.bl_idname in WITHOUT_SURFACE:
        return None
    known = inputs.known()
    if known is not None:
        clear = inputs.value_or("Transmission Weight", 0.0) if node.bl_idname == "ShaderNodeBsdfPrincipled" else 0.0
        if known.material.metallic > 0.5 or clear <= 0.5:
            return None
        return inputs.colour("Base Color"), f"transmission of node {node.name} is not baked; lower its Transmission"
    if not any(n.bl_idname in WITH_HIGHLIGHT | CLEAR and not n.mute for n in reachable(inputs.output)):
        return None
    return _found_colour(inputs), f"node {node.name} ({node.bl_label}) is none that is read; {REMEDY}"


def _found_colour(inputs: _Inputs) -> tuple[float, float, float]:
    """The first constant colour, brighter than black, of the shaders that a surface is made of, else the viewport's."""
    colours = [inputs.material.diffuse_color]
    for node in reachable(inputs.output):
        sockets = [s for s in node.inputs if s.name in ("Base Color", "Color") and s.type == "RGBA"]
        if any(o.type == "SHADER" for o in node.outputs) and sockets and node.bl_idname not in WITHOUT_SURFACE:
            value = constant_of(sockets[0])
            if value is not None and max(value[:3]) > 0.0:
                colours.insert(len(colours) - 1, value)
    return tuple(float(np.clip(c, 0.0, 1.0)) for c in colours[0][:3])


class _Inputs:
    """The inputs of one material's surface node as numbers."""

    def __init__(self, material: bpy.types.Material, warnings: list[str],
                 socket: bpy.types.NodeSocket | None = None, groups: Groups = ()) -> None:
        self.material, self._warnings = material, warnings
        self.output = material.node_tree.get_output_node("CYCLES") if material.node_tree is not None else None
        if socket is None and self.output is not None:
            socket = self.output.inputs["Surface"]
        self.node: bpy.types.Node | None = None
        if socket is not None:
            found, _, self._groups = origin_of(socket, groups)
            self.node = None if found is None else found.node

    def read(self) -> Surface:
        """The surface; diffuse, with a warning where it has a highlight, if it is none of those that are read."""
        if self.node is None or self.node.mute:
            return PLAIN
        surface = self.known()
        if surface is not None:
            return surface
        if any(node.bl_idname in WITH_HIGHLIGHT and not node.mute for node in reachable(self.output)):
            self._warn(f"only its diffuse part is baked: its surface, node {self.node.name} ({self.node.bl_label}), is"
                       f" none that is read; {REMEDY}")
        return PLAIN

    def known(self) -> Surface | None:
        """The surface of a node of a kind that is read; None of another."""
        kind = self.node.bl_idname
        if self.node.mute:
            return None
        if kind == "ShaderNodeBsdfPrincipled":
            return self._principled()
        if kind == "ShaderNodeBsdfMetallic":
            return self._metallic()
        if kind in GLOSSY_NODES:
            return self._glossy()
        if kind == "ShaderNodeBsdfDiffuse":
            return PLAIN
        return self._mixed() if kind == "ShaderNodeMixShader" else None

    def _mixed(self) -> Surface | None:
        """A Mix Shader as one surface with mixed parameters; what is beside Transparent or Emission as it is alone."""
        share = float(np.clip(self._numbers(self.node.inputs[0])[0], 0.0, 1.0))
        sides = [_Inputs(self.material, self._warnings, socket, self._groups) for socket in self.node.inputs[1:3]]
        if share in (0.0, 1.0):
            chosen = sides[int(share)]
            return PLAIN if chosen.node is None else chosen.known()
        solid = [side for side in sides if side.node is not None and side.node.bl_idname not in WITHOUT_SURFACE]
        surfaces = [side.known() for side in solid]
        if not surfaces or any(surface is None for surface in surfaces):
            return None
        if len(surfaces) == 1:
            if not surfaces[0].material.is_diffuse:
                self._warn(f"node {self.node.name} mixes its surface with what has none, which its highlight ignores")
            return surfaces[0]
        first, second = surfaces
        if first.material.is_diffuse and second.material.is_diffuse:
            return PLAIN
        self._warn(f"node {self.node.name} mixes two surfaces, which are baked as one with mixed parameters")
        stronger = second if share > 0.5 or first.tangent is None else first
        mixed = replace(mix(first.material, second.material, share), name=self.material.name)
        return Surface(mixed, stronger.tangent or first.tangent)

    def _principled(self) -> Surface:
        for name in LEFT_OUT:
            socket = self.node.inputs.get(name)
            if socket is not None and constant_of(socket, self._groups) != 0.0:
                self._warn(f"{name} of node {self.node.name} is left out")
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
        medium = "Subsurface IOR" if self.node.subsurface_method == "RANDOM_WALK_SKIN" else "IOR"
        material = SurfaceMaterial(
            self.material.name, self.colour("Base Color"), self._share("Roughness"), metallic, ior, level,
            self.colour("Specular Tint"), anisotropic,
            self._value("Anisotropic Rotation") % 1.0 if anisotropic > 0.0 else 0.0, weight, radius,
            max(self._value(medium), 1.0) if weight > 0.0 else 1.4,
            float(np.clip(self._value("Subsurface Anisotropy"), -0.99, 0.99)) if weight > 0.0 else 0.0)
        directed = anisotropic > 0.0 and (level > 0.0 or metallic > 0.0)
        return Surface(material, self._tangent() if directed else None)

    def _metallic(self) -> Surface:
        """A Metallic BSDF: the metal of a Principled BSDF; of measured constants its reflectance at the normal."""
        self._check_distribution()
        tint = (1.0, 1.0, 1.0)
        if self.node.fresnel_type == "PHYSICAL_CONDUCTOR":
            n, k = (self._numbers(self.node.inputs[name])[:3] for name in ("IOR", "Extinction"))
            reflectance = ((n - 1.0) ** 2 + k ** 2) / ((n + 1.0) ** 2 + k ** 2)
            colour = tuple(float(c) for c in np.clip(reflectance, 0.0, 1.0))
        else:
            colour, tint = self.colour("Base Color"), self.colour("Edge Tint")
        anisotropic = self._share("Anisotropy")
        turn = self._value("Rotation") % 1.0 if anisotropic > 0.0 else 0.0
        material = SurfaceMaterial(self.material.name, colour, self._share("Roughness"), 1.0, specular_level=0.0,
                                   specular_tint=tint, anisotropic=anisotropic, anisotropic_rotation=turn)
        return Surface(material, self._tangent() if anisotropic > 0.0 else None)

    def _subsurface(self) -> tuple[float, tuple[float, float, float]]:
        """Weight, and the mean free path per channel in metres: Cycles does not scale it with the object."""
        weight = self._share("Subsurface Weight")
        if weight <= 0.0:
            return 0.0, (0.0, 0.0, 0.0)
        scale = max(self._value("Subsurface Scale"), 0.0)
        radius = self._numbers(self.node.inputs["Subsurface Radius"])
        return weight, tuple(max(float(r), 0.0) * scale for r in radius[:3])

    def _glossy(self) -> Surface:
        """A Glossy BSDF as a metal whose edge tint makes it reflect the same colour at 82 degrees as head-on.

        Its anisotropy a gives widths alpha (1 - a) along the tangent and alpha / (1 - a) across it; a Principled's b
        alpha / s and alpha s with s = sqrt(1 - 0.9 b). So s = 1 - |a|, and the tangent turns by a quarter where a > 0.
        """
        self._check_distribution()
        colour = self.colour("Color")
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
        material = SurfaceMaterial(self.material.name, colour, self._share("Roughness"), 1.0, specular_level=0.0,
                                   specular_tint=edge, anisotropic=anisotropic, anisotropic_rotation=turn)
        return Surface(material, self._tangent() if anisotropic > 0.0 else None)

    def _check_distribution(self) -> None:
        if "GGX" not in self.node.distribution:
            lobe = self.node.distribution.replace("_", "-").title()
            self._warn(f"the {lobe} lobe of node {self.node.name} is baked as GGX of the same roughness")

    def _tangent(self) -> Tangent:
        node = source_of(self.node.inputs["Tangent"], self._groups)
        if node is None:
            return DEFAULT_TANGENT
        if node.bl_idname == "ShaderNodeTangent" and not node.mute:
            return (("UV_MAP", node.uv_map) if node.direction_type == "UV_MAP" else ("RADIAL", node.axis))
        self._warn("its Tangent is linked to a node that is not read; the default tangent is used")
        return DEFAULT_TANGENT

    def _value(self, name: str) -> float:
        return float(self._numbers(self.node.inputs[name])[0])

    def value_or(self, name: str, missing: float) -> float:
        """The value of an input, or another where the node has none of that name."""
        return self._value(name) if name in self.node.inputs else missing

    def _share(self, name: str) -> float:
        return float(np.clip(self._value(name), 0.0, 1.0))

    def colour(self, name: str) -> tuple[float, float, float]:
        """The value of a colour input, 0..1."""
        return tuple(float(c) for c in np.clip(self._numbers(self.node.inputs[name])[:3], 0.0, 1.0))

    def _numbers(self, socket: bpy.types.NodeSocket) -> NDArray[np.float64]:
        """The value of an input, of one number or several; a stand-in with a warning where it varies."""
        value = constant_of(socket, self._groups)
        if value is not None:
            return np.nan_to_num(np.atleast_1d(np.asarray(value, np.float64)))
        output, place, groups = origin_of(socket, self._groups)
        name = socket.name if socket.name != "Fac" else f"Fac of node {self.node.name}"
        found = None if output is None else _image_mean(output, groups)
        if found is not None:
            image, mean = found
            self._warn(f"{name} varies; the mean of image {image.name} stands in")
            return mean if socket.type == "RGBA" else np.atleast_1d(np.sum(mean * LUMINANCE))
        # At the wall of a group the value of the group's own input, converted as Cycles does.
        value = place.default_value if output is None else socket.default_value
        plain = np.atleast_1d(np.asarray(value if isinstance(value, (float, int)) else tuple(value), np.float64))
        if output is None:
            plain = _converted(plain, socket)
            return np.nan_to_num(plain)
        self._warn(f"{name} varies; its unlinked value {', '.join(f'{v:.3g}' for v in plain[:3])} stands in")
        return plain

    def _warn(self, what: str) -> None:
        line = f"Material {self.material.name}: {what}"
        if line not in self._warnings:
            self._warnings.append(line)


def mix(first: SurfaceMaterial, second: SurfaceMaterial, share: float) -> SurfaceMaterial:
    """One material for a mix with `share` (0..1) of the second: every parameter weighs by the light that it governs.

    Exact where the two differ in what their layers weigh only; of two roughnesses one between them is taken.
    """
    pair, shares = (first, second), np.array([1.0 - share, share])
    metal = shares * [m.metallic for m in pair]
    layer = shares * [(1.0 - m.metallic) * m.specular_level for m in pair]
    inside = shares * [(1.0 - m.metallic) * m.subsurface_weight for m in pair]
    rest = max(1.0 - float(metal.sum()), 1e-6)
    # A dielectric's highlight is about a tenth of a metal's.
    shown = metal + 0.1 * layer

    def mean(name: str, weights: NDArray[np.float64]) -> tuple[float, ...] | float:
        weights = weights if weights.sum() > 0.0 else shares
        values = np.sum([w * np.asarray(getattr(m, name)) for w, m in zip(weights, pair, strict=True)], axis=0)
        values = values / weights.sum()
        return float(values) if np.ndim(values) == 0 else tuple(float(v) for v in values)

    return replace(first, base_colour=mean("base_colour", metal if metal.sum() > 0.0 else inside),
                   roughness=mean("roughness", shown), metallic=float(metal.sum()), ior=mean("ior", layer),
                   specular_level=float(layer.sum()) / rest, specular_tint=mean("specular_tint", shown),
                   anisotropic=mean("anisotropic", shown),
                   anisotropic_rotation=pair[int(shown[1] * second.anisotropic > shown[0] * first.anisotropic)]
                   .anisotropic_rotation,
                   subsurface_weight=float(inside.sum()) / rest, subsurface_radius=mean("subsurface_radius", inside),
                   subsurface_ior=mean("subsurface_ior", inside),
                   subsurface_anisotropy=mean("subsurface_anisotropy", inside))


def _converted(value: NDArray[np.float64], socket: bpy.types.NodeSocket) -> NDArray[np.float64]:
    """A value as the kind of a socket: a colour to its luminance, a number to a grey."""
    if socket.type == "VALUE":
        return value[:1] if len(value) < 3 else np.atleast_1d(np.sum(value[:3] * LUMINANCE))
    return np.repeat(value, 3) if len(value) == 1 else value


def _image_mean(output: bpy.types.NodeSocket, groups: Groups) -> tuple[bpy.types.Image, NDArray[np.float64]] | None:
    """The image and the mean (3,) of what an output gives: an image texture's colour or alpha, or one channel of it
    behind a Separate Color node; None where it is something else."""
    node, channel = output.node, None
    if node.bl_idname == "ShaderNodeSeparateColor" and node.mode == "RGB" and not node.mute:
        channel = list(node.outputs).index(output)
        found = origin_of(node.inputs[0], groups)[0]
        if found is None:
            return None
        output, node = found, found.node
    image = getattr(node, "image", None) if node.bl_idname == "ShaderNodeTexImage" and not node.mute else None
    mean = None if image is None else mean_of_image(image, output.name == "Alpha")
    if mean is None:
        return None
    return image, mean if channel is None else np.repeat(mean[channel], 3)


def mean_of_image(image: bpy.types.Image, alpha: bool = False) -> NDArray[np.float64] | None:
    """Mean colour (3,) of an image, linear as Cycles sees it, or of its alpha; None where it has no pixels."""
    width, height = image.size
    if width * height == 0 or image.channels == 0:
        return None
    pixels = np.empty(width * height * image.channels, np.float32)
    image.pixels.foreach_get(pixels)
    pixels = pixels.reshape(-1, image.channels)
    if alpha:
        return np.full(3, float(pixels[:, 3].mean(dtype=np.float64)) if image.channels == 4 else 1.0)
    colours = pixels[:, :3]
    if not image.is_float and image.colorspace_settings.name == "sRGB":  # float images are held scene-linear
        colours = np.where(colours <= 0.04045, colours / 12.92, ((np.maximum(colours, 0.0) + 0.055) / 1.055) ** 2.4)
    mean = np.nan_to_num(colours.mean(axis=0, dtype=np.float64))
    return np.repeat(mean[:1], 3) if len(mean) < 3 else mean
