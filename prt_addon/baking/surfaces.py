# SPDX-License-Identifier: GPL-3.0-or-later
"""What the materials of a scene ask of a bake: rows for highlights, a term for subsurface light, what is left out.

Everything here is per material and done once, before the first ray; receivers look it up by their material's number.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..basis.hemisphere import Indices, functions_of, gram_matrix
from ..basis.spherical_harmonics import expand_bands
from ..compression.encoding import Encoding
from ..relighting.exit_radiance import cluster_constants, combine_rows, exit_radiance, hemisphere_values
from ..scene.needs import LeftOut
from ..scene.scene_mesh import SceneMesh, SceneObject
from ..scene.surface_material import SurfaceMaterial
from ..transport.brdf import (
    Reflection,
    choose_rows,
    diffuse_left,
    reflection_matrix,
    reflection_of_material,
    ringing_window,
)
from ..transport.kernel_window import softened
from ..transport.lamp_kernel import lamp_kernel
from .settings import BakeSettings

# Order of the functions that incident radiance is turned and reflected in, and the smallest eigenvalue of their Gram
# matrix that is inverted: white metal of roughness 0.3 is then within 0.3 % of white up to 60 degrees, where order 5
# and 1e-2 leave 3 % (receivers lack the little that faces hide at the horizon, and a narrow kernel amplifies that).
INCIDENT_ORDER = 7
SMALLEST_INCIDENT = 3e-2
# The constant function y_0, through which subsurface light leaves (Sloan 2003, section 3).
CONSTANT = 0.5 / np.sqrt(np.pi)
# Mean square of the albedo below which a black surface's diffuse row is still kept right, for materials edited later.
DARKEST = 1e-4
# Share of the light below which a metal is left black whatever its preset: nobody misses its highlight.
BLACK_METAL = 0.03
# Metallic share from which on a mirror is blurred rather than left out, because its light would be missed.
MISSED_METAL = 0.15
# Angles of the views from the normal at which exit radiance is measured, each at four azimuths.
MEASURED_ANGLES = (0.0, 30.0, 60.0, 80.0, 89.0)
_GREY = 1e-6


@dataclass(frozen=True)
class SurfacePart:
    """How one material is held.

    kernel: (rows, incident functions, 1 or 3), None where it has no rows of its own; window: (columns,) factors on the
    light that a highlight sharper than the light's order reflects, None where all are 1; diffuse_share: of its diffuse
    layer that the layers above leave, a mean over views; dimming: (rows,) how that differs over views; highlight:
    (3,) mean share of the light that its highlight returns; translucent: subsurface light is baked; subsurface_share:
    of it that leaves, what is no metal and what the highlight lets through; lamp_kernel: (rows, LAMP_ORDER^2, 1 or 3)
    for the direct light of lamps, None where kernel is; lamp_share: as diffuse_share, for the light of lamps, which no
    bake takes through bodies: there the diffuse layer sends back that part, too.
    """

    material: SurfaceMaterial
    kernel: NDArray[np.float64] | None
    window: NDArray[np.float64] | None
    diffuse_share: float
    dimming: NDArray[np.float64]
    highlight: NDArray[np.float64]
    translucent: bool
    subsurface_share: float
    lamp_kernel: NDArray[np.float64] | None = None
    lamp_share: float = 1.0


@dataclass(frozen=True)
class SurfacePlan:
    """parts: by the scene's material number; functions: of the rows of every object with a highlight; left_out, hints:
    for the report."""

    parts: tuple[SurfacePart, ...]
    functions: Indices
    left_out: list[LeftOut] = field(default_factory=list)
    hints: list[str] = field(default_factory=list)

    def glossy_points(self, scene: SceneMesh) -> NDArray[np.bool_]:
        """(p,) which points of targets have a highlight that is baked."""
        return self._points(scene, [part.kernel is not None for part in self.parts])

    def translucent_points(self, scene: SceneMesh) -> NDArray[np.bool_]:
        """(p,) which points of targets show baked subsurface light."""
        return self._points(scene, [part.translucent for part in self.parts])

    @staticmethod
    def _points(scene: SceneMesh, of_material: list[bool]) -> NDArray[np.bool_]:
        targets = np.zeros(len(scene.points), bool)
        for target in scene.objects:
            if target.is_target:
                targets[target.points] = True
        return targets & ~scene.loose & np.array(of_material)[scene.material]

    def functions_of_object(self, scene: SceneMesh, target: SceneObject) -> Indices:
        """The hemispherical functions of an object's rows; none where it is diffuse only."""
        used = [self.parts[number] for number in np.unique(scene.material[target.points])]
        if any(part.kernel is not None for part in used):
            return self.functions
        return functions_of(1) if any(part.translucent for part in used) else np.zeros(0, np.int64)

    @property
    def coloured(self) -> bool:
        """Whether some highlight or subsurface light differs between channels."""
        return any((part.kernel is not None and part.kernel.shape[2] == 3) or part.translucent for part in self.parts)

    def diffuse_albedo(self, scene: SceneMesh) -> NDArray[np.float32]:
        """(p, 3) the diffuse part of what surfaces with rows of their own send back; for others the whole."""
        whole = self.bounce_albedo(scene)
        has_rows = np.array([part.kernel is not None for part in self.parts])
        share = np.array([part.diffuse_share for part in self.parts], np.float32)
        rows = self.glossy_points(scene) & has_rows[scene.material]
        return np.where(rows[:, None], scene.albedo * share[scene.material, None], whole)

    def bounce_albedo(self, scene: SceneMesh) -> NDArray[np.float32]:
        """(p, 3) what surfaces send back of the light: the diffuse part and, spread evenly, the highlight."""
        if all(part.material.is_diffuse for part in self.parts):
            return scene.albedo
        share = np.array([part.diffuse_share if part.kernel is not None else 1.0 for part in self.parts], np.float32)
        # Where a highlight is not baked its light stays in the diffuse layer; a metal has none to put it in.
        highlight = np.array([part.highlight * (1.0 if part.kernel is not None else part.material.metallic)
                              for part in self.parts], np.float32)
        return scene.albedo * share[scene.material, None] + highlight[scene.material]


def is_harmonic(settings: BakeSettings) -> bool:
    """Whether an order of spherical harmonics limits the light that is baked."""
    return settings.distant_light and settings.distant_basis == "sh"


def plan_surfaces(scene: SceneMesh, settings: BakeSettings) -> SurfacePlan:
    """What each material of the scene gets. Materials of casters that are not baked only need their bounced light."""
    used = {int(number) for target in scene.objects if target.is_target
            for number in np.unique(scene.material[target.points])}
    left_out: list[LeftOut] = []
    hints: list[str] = []
    order = max(INCIDENT_ORDER, settings.order)
    reflections: dict[int, Reflection] = {
        number: reflection_of_material(material, order) for number, material in enumerate(scene.materials)
        if material.specular_level > 0.0 or material.metallic > 0.0}
    rows = {number: _rows(scene.materials[number], reflections[number], settings, left_out, hints)
            for number in sorted(used & reflections.keys())}
    functions = functions_of(max(rows.values())) if any(rows.values()) else np.zeros(0, np.int64)
    parts = tuple(_part(material, reflections.get(number), functions if rows.get(number) else None, number in used,
                        settings, left_out, hints) for number, material in enumerate(scene.materials))
    return SurfacePlan(parts, functions, left_out, hints)


def _rows(material: SurfaceMaterial, reflection: Reflection, settings: BakeSettings, left_out: list[LeftOut],
          hints: list[str]) -> int:
    """Rows that the highlight of a material gets; 0 leaves it to the diffuse layer."""
    name = f"the highlight of material {material.name or 'without name'}"
    albedo = float(reflection.albedo().max())
    if settings.glossy_rows == 0:
        why = "glossy_rows is 0: metal is drawn black" if material.metallic > 0.5 else "glossy_rows is 0"
        left_out.append(LeftOut(name, why, f"view-dependent rows; it returns {albedo:.1%} of the light"))
        return 0
    # A metal has less of a diffuse layer to leave its light to, or none: it would be drawn black.
    least = max(settings.glossy_albedo * (1.0 - material.metallic), min(settings.glossy_albedo, BLACK_METAL))
    if albedo < least:
        left_out.append(LeftOut(name, f"it returns {albedo:.1%} of the light, less than glossy_albedo",
                                "view-dependent rows"))
        return 0
    # Without harmonics the order that limits is that of what receivers see.
    order = settings.order if is_harmonic(settings) else INCIDENT_ORDER
    choice = choose_rows(material, order, settings.glossy_rows, reflection)
    if choice.kind == "glossy":
        hints.append(f"{name}: {choice.why}")
        return choice.rows
    left_out.append(LeftOut(name if choice.kind == "diffuse" else f"sharp reflections of material {material.name}",
                            choice.why, "view-dependent rows"))
    # A metal has no diffuse layer that could stand in: a blurred reflection is nearer the truth than black.
    return settings.glossy_rows if choice.kind == "mirror" and material.metallic > MISSED_METAL else 0


def _part(material: SurfaceMaterial, reflection: Reflection | None, functions: Indices | None, is_used: bool,
          settings: BakeSettings, left_out: list[LeftOut], hints: list[str]) -> SurfacePart:
    """One material's part. functions: None where its highlight gets no rows."""
    highlight = np.zeros(3) if reflection is None else np.broadcast_to(reflection.albedo(), 3)
    translucent = material.is_translucent and settings.subsurface and is_used
    if material.is_translucent and is_used and not settings.subsurface and settings.distant_light:
        left_out.append(LeftOut(f"subsurface light of material {material.name}", "subsurface is false",
                                "the subsurface stage and three channels"))
    if material.is_translucent and is_used and settings.local_light and not settings.subsurface_links:
        left_out.append(LeftOut(f"light of lamps through material {material.name}", "subsurface_links is 0",
                                "16 bytes per point and link"))
    if material.is_translucent and is_used and not settings.local_light and settings.subsurface_links:
        left_out.append(LeftOut(f"links for lamps through material {material.name}", "lighting is environment alone",
                                "16 bytes per point and link"))
    through = 1.0 - material.subsurface_weight if translucent else 1.0
    inside = material.subsurface_weight * (1.0 - material.metallic)
    if functions is None:
        return SurfacePart(material, None, None, through, np.zeros(1), highlight, translucent, inside)
    kernel = reflection_matrix(reflection, functions, np.arange(INCIDENT_ORDER ** 2), SMALLEST_INCIDENT)
    if settings.glossy_window and settings.distant_light and not is_harmonic(settings):
        kernel, kept = softened(kernel, functions)
        if kept < 1.0:
            hints.append(f"the highlight of material {material.name}: a sun would ring in its {len(functions)} rows; a"
                         f" window leaves {kept:.0%} of the highest band (glossy_window=false keeps all)")
    if kernel.shape[2] == 3 and np.ptp(kernel, axis=2).max() <= _GREY * np.abs(kernel).max():
        kernel = kernel[:, :, :1]
    left = diffuse_left(material, functions)
    bands = np.ones(1)
    if settings.glossy_window and is_harmonic(settings):
        bands = ringing_window(reflection, settings.order)
    if bands[-1] < 1.0:
        hints.append(f"the highlight of material {material.name}: light of order {settings.order} would ring in it; a"
                     f" window leaves {bands[-1]:.0%} of the highest band (glossy_window=false keeps all)")
    window = expand_bands(bands) if bands[-1] < 1.0 else None
    lamps = lamp_kernel(reflection, functions, settings.glossy_window) if settings.local_light else None
    if lamps is not None:
        lamps = lamps[:, :, :kernel.shape[2]]
    return SurfacePart(material, kernel, window, left.mean * through, left.coefficients * through, highlight,
                       translucent, inside * left.mean, lamps, left.mean)


def row_metric(functions: Indices, albedo: NDArray[np.float32]) -> NDArray[np.float64] | None:
    """The metric (rows, rows) in which an object's rows are compressed: radiance squared over the hemisphere of views.

    The diffuse row is drawn times the albedo (p, 3), the others as they are. None for diffuse rows alone.
    """
    if not len(functions):
        return None
    metric = np.zeros((len(functions) + 1, len(functions) + 1))
    metric[0, 0] = 2.0 * np.pi * max(float(np.mean(np.square(albedo, dtype=np.float64))), DARKEST)
    metric[1:, 1:] = gram_matrix(functions)
    return metric


@dataclass(frozen=True)
class WhiteWorld:
    """Exit radiance of an object under a white world of radiance 1, all receivers and the views of MEASURED_ANGLES.

    Nothing reflects less than 0 or, without light of its own, more than 1: smallest and largest say how far the
    encoded transfer is from that. mean: over receivers and views weighted by their cosine.
    """

    smallest: float
    largest: float
    mean: float


def white_world(encoding: Encoding, shape: tuple[int, int, int], functions: Indices, albedo: NDArray[np.float32],
                white: NDArray[np.float64] | None = None) -> WhiteWorld:
    """What is drawn of an object in a white world. shape: (rows, columns, channels) of the signal; functions: of rows
    1, 2, ... (none where it is diffuse); albedo: (p, 3) of the encoded points; white: (distant columns, 3) that world
    in the columns (`DistantBasis.white_light`), None: spherical harmonics."""
    light = np.zeros((shape[1], 3))
    if white is None:
        light[0] = 1.0 / CONSTANT  # of the constant function, for radiance 1
    else:
        light[:len(white)] = white
    constants = cluster_constants(encoding.bases.reshape(*encoding.bases.shape[:2], *shape), light)
    rows = exit_radiance(encoding.cluster, encoding.weights, constants)
    smallest, largest, total, weight = np.inf, -np.inf, 0.0, 0.0
    for view in _measured_views():
        values = hemisphere_values(tuple(int(i) for i in functions), view[None]) if len(functions) else np.zeros((1, 0))
        radiance = combine_rows(rows, albedo, np.repeat(values, len(rows), axis=0))
        smallest, largest = min(smallest, float(radiance.min())), max(largest, float(radiance.max()))
        total += view[2] * float(radiance.mean(dtype=np.float64))
        weight += view[2]
    return WhiteWorld(smallest, largest, total / weight)


def _measured_views() -> NDArray[np.float64]:
    """Views (n, 3) in the frame of a receiver."""
    angle, turn = np.radians(MEASURED_ANGLES)[:, None], np.arange(4) * np.pi / 2 + np.pi / 8
    return np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn),
                     np.broadcast_to(np.cos(angle), (len(angle), len(turn)))], axis=-1).reshape(-1, 3)
