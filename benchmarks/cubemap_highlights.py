# SPDX-License-Identifier: GPL-3.0-or-later
"""Highlights of a brass ball on a floor under an HDRI: cubemap columns against spherical harmonics. Needs the bpy wheel
(for its world images).

    python benchmarks/cubemap_highlights.py [--world courtyard] [--roughness 0.4] [--rows 16,24]
        [--bases sh5,sh7,sh10,cubemap8,cubemap16]

Relative RMS of the highlight alone over receivers and views, against paths (`baking.highlight_reference`), by step:
what the rows cut (windows included), what light finer than the columns does, compression, and the total; mean and
lowest radiance over all receivers and views up to 60 degrees from the normal, and the bytes of the bases. Seconds are
of stages that harmonics have too, on one thread.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the bake's process; before numpy loads

import bpy  # noqa: F401  before what it brings is imported
import numpy as np
from against_cycles import light_image
from common import print_table
from numpy.typing import NDArray

from prt_addon.baking.distant_basis import DistantBasis
from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import make_settings
from prt_addon.lighting.reference_light import ReferenceLight
from prt_addon.relighting.exit_radiance import view_radiance
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import SurfaceMaterial
from prt_addon.storage.container import BakedTransfer
from tests.core.shapes import plane, sphere

BRASS = SurfaceMaterial("brass", (0.95, 0.65, 0.25), roughness=0.4, metallic=1.0, specular_level=0.5)
STEPS = ("rows", "basis", "compression", "total")


def scene_of(roughness: float, subdivisions: int) -> SceneMesh:
    """The ball and the floor of the demo, alone."""
    ball = replace(sphere(centre=(0.0, 0.0, 0.38), radius=0.38, albedo=(0.0, 0.0, 0.0), subdivisions=subdivisions),
                   materials=(replace(BRASS, roughness=roughness),))
    return SceneMesh.assemble([plane(size=4.0, cells=40, albedo=(0.36, 0.35, 0.34)), ball], 0.0)


def lowest_and_mean(ball: BakedTransfer, light: NDArray[np.float64]) -> tuple[float, float]:
    """Over receivers of the upper half and views up to 60 degrees from their normals."""
    bitangents = np.cross(ball.normals, ball.tangents)
    upper = ball.normals[:, 2] > 0.0
    shown = []
    for angle in np.radians([0.0, 30.0, 60.0]):
        for turn in np.arange(4) * np.pi / 2:
            views = np.cos(angle) * ball.normals + np.sin(angle) * (
                np.cos(turn) * ball.tangents + np.sin(turn) * bitangents)
            shown.append(view_radiance(ball, light, views)[upper])
    values = np.concatenate(shown)
    return float(values.min()), float(values.mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", default="courtyard")
    parser.add_argument("--roughness", default="0.4")
    parser.add_argument("--rows", default="16,24")
    parser.add_argument("--bases", default="sh5,sh7,sh10,cubemap8,cubemap16")
    parser.add_argument("--subdivisions", type=int, default=4)
    parser.add_argument("--window", default="true")
    arguments = parser.parse_args()
    light = ReferenceLight.of(light_image(arguments.world), None, [], arguments.world)
    rows = []
    for roughness in map(float, arguments.roughness.split(",")):
        scene = scene_of(roughness, arguments.subdivisions)
        for name in arguments.bases.split(","):
            for count in arguments.rows.split(","):
                basis, size = name.rstrip("0123456789"), name.lstrip("abcdefghijklmnopqrstuvwxyz")
                settings = make_settings("standard", {
                    "distant_basis": basis, "order" if basis == "sh" else "cubemap_size": size, "glossy_rows": count,
                    "threads": "1", "glossy_window": arguments.window})
                result = exhaust(bake(scene, settings, light=light))
                ball, report = result.objects["sphere"], result.report
                columns = DistantBasis(*((int(size), 0) if basis == "sh" else (0, int(size))))
                lowest, mean = lowest_and_mean(ball, columns.coefficients(light))
                errors = report["highlight_errors"]
                rows.append([roughness, name, int(count), *(100 * errors[step]["relative_rms"] for step in STEPS),
                             lowest, mean, ball.bases.nbytes / 1e6,
                             sum(stage["seconds"] for stage in report["stages"] if stage["name"] != "errors"),
                             report["peak_bytes"] / 1e6])
                print(rows[-1], flush=True)
    print_table(["roughness", "columns", "rows", "rows %", "light %", "compression %", "total %", "lowest", "mean",
                 "bases MB", "seconds", "peak MB"], rows)


if __name__ == "__main__":
    main()
