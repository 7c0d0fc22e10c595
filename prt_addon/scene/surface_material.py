# SPDX-License-Identifier: GPL-3.0-or-later
"""What a material does with light beyond diffuse reflection, as numbers of its own and not of a place on it."""

from __future__ import annotations

from dataclasses import dataclass

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class SurfaceMaterial:
    """The view-dependent and translucent part of a material, in the terms of Blender's Principled BSDF.

    base_colour: mean over the material where it is textured; linear Rec.709, 0..1 (the F0 of a metal, the colour of
    subsurface light). roughness: 0..1, GGX alpha is its square. metallic: 0..1. ior: above 1. specular_level: 0..1,
    0.5 leaves the IOR's own reflectance F0 = ((ior - 1) / (ior + 1))^2 as it is, 1 doubles it. specular_tint: factor
    on the dielectric's F0 (the edge tint of a metal). anisotropic: 0..1. anisotropic_rotation: turns, 0..1.
    subsurface_weight: 0..1. subsurface_radius: mean free path per channel in metres, scale included.
    subsurface_ior, subsurface_anisotropy: of the medium.
    """

    name: str = ""
    base_colour: Colour = (0.8, 0.8, 0.8)
    roughness: float = 0.5
    metallic: float = 0.0
    ior: float = 1.5
    specular_level: float = 0.0
    specular_tint: Colour = (1.0, 1.0, 1.0)
    anisotropic: float = 0.0
    anisotropic_rotation: float = 0.0
    subsurface_weight: float = 0.0
    subsurface_radius: Colour = (0.0, 0.0, 0.0)
    subsurface_ior: float = 1.4
    subsurface_anisotropy: float = 0.0

    @property
    def is_diffuse(self) -> bool:
        """Whether the material has neither a highlight nor subsurface light."""
        return self.specular_level <= 0.0 and self.metallic <= 0.0 and not self.is_translucent

    @property
    def is_translucent(self) -> bool:
        """Whether light enters the surface and leaves elsewhere."""
        return self.subsurface_weight > 0.0 and max(self.subsurface_radius) > 0.0


DIFFUSE = SurfaceMaterial()
