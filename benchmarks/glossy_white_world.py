# SPDX-License-Identifier: GPL-3.0-or-later
"""Exit radiance of white metal in a white world, where 0 to 1 is physical: beside a wall, and on finer and finer balls.

    python benchmarks/glossy_white_world.py [--presets draft,standard] [--roughness 0.3,0.2] [--balls 3,4,5]

The wall: smallest and largest over receivers and views up to 89 degrees, without bounces, with the highlights as their
rows are fitted and as `transport.positivity` leaves them. The floor and the balls: mean over receivers and azimuths at
views of 0, 60, 80 and 89 degrees; what is missing is hidden by the faces (the floor's hide nothing).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from common import print_table

from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import make_settings
from prt_addon.relighting.exit_radiance import cluster_constants, combine_rows, exit_radiance, hemisphere_values
from prt_addon.scene.object_mesh import ObjectMesh
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import SurfaceMaterial
from prt_addon.storage.container import BakedTransfer
from prt_addon.transport import glossy
from tests.core.shapes import box, plane, sphere

OPTIONS = {"bounces": "0", "spacing": "0", "error_receivers": "0"}
AZIMUTHS = np.radians(np.arange(0.0, 360.0, 45.0))


def seen(container: BakedTransfer, degrees: float) -> np.ndarray:
    """Radiance (azimuths, receivers) towards views at an angle from the normals."""
    light = np.zeros((container.columns, 3))
    light[0] = np.sqrt(4.0 * np.pi)
    rows = exit_radiance(container.cluster, container.weights, cluster_constants(container.bases, light))
    sine, cosine = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    views = np.stack([sine * np.cos(AZIMUTHS), sine * np.sin(AZIMUTHS), np.full(len(AZIMUTHS), cosine)], axis=1)
    values = hemisphere_values(container.functions, views)
    return np.array([combine_rows(rows, container.albedo, np.broadcast_to(v, (len(rows), len(v))))[:, 0]
                     for v in values])


def baked(meshes: list[ObjectMesh], preset: str) -> BakedTransfer:
    """The one target among the meshes."""
    return next(iter(exhaust(bake(SceneMesh.assemble(meshes), make_settings(preset, OPTIONS))).objects.values()))


def range_beside_wall(material: SurfaceMaterial, preset: str, keep: Callable) -> str:
    """Smallest and largest exit radiance of a floor beside a tall wall. keep: in place of `keep_positive`."""
    floor = replace(plane(size=6, cells=32, albedo=(0, 0, 0)), materials=(material,))
    walls = [box("wall", (-3.2, -8, 0), (-3, 8, 40), albedo=(0, 0, 0), target=False),
             box("block", (0, -0.2, 0), (0.4, 0.2, 1), albedo=(0, 0, 0), target=False)]
    usual, glossy.keep_positive = glossy.keep_positive, keep
    try:
        container = baked([floor, *walls], preset)
    finally:
        glossy.keep_positive = usual
    values = np.array([seen(container, degrees) for degrees in (0.0, 30.0, 60.0, 80.0, 89.0)])
    return f"{values.min():.3f} .. {values.max():.3f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", default="draft,standard")
    parser.add_argument("--roughness", default="0.3,0.2")
    parser.add_argument("--balls", default="3,4,5", help="subdivisions of an icosphere")
    arguments = parser.parse_args()
    materials = [SurfaceMaterial("metal", (1.0, 1.0, 1.0), float(r), 1.0) for r in arguments.roughness.split(",")]
    rows = [[preset, material.roughness, range_beside_wall(material, preset, lambda matrices, surface: None),
             range_beside_wall(material, preset, glossy.keep_positive)]
            for preset in arguments.presets.split(",") for material in materials]
    print_table(["preset", "roughness", "rows as fitted", "kept above black"], rows)
    shapes = [plane("floor", size=2, cells=6, albedo=(0, 0, 0))] + [
        sphere(f"ball of {subdivisions}", subdivisions=int(subdivisions), albedo=(0, 0, 0))
        for subdivisions in arguments.balls.split(",")]
    furnace = []
    for material in materials:
        for shape in shapes:
            container = baked([replace(shape, materials=(material,))], "standard")
            furnace.append([shape.name, len(container.positions), material.roughness,
                            *(float(seen(container, degrees).mean()) for degrees in (0.0, 60.0, 80.0, 89.0))])
    print_table(["shape", "receivers", "roughness", "0 degrees", "60", "80", "89"], furnace)


if __name__ == "__main__":
    main()
