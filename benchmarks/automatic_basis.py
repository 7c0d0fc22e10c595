# SPDX-License-Identifier: GPL-3.0-or-later
"""What the automatic sky chooses under very different lights, and its prediction against bakes' measured errors.

    python benchmarks/automatic_basis.py                         spot on a ground of its own size, standard
    python benchmarks/automatic_basis.py --mesh stanford-bunny.obj --receivers 64

Lights: HDRIs of Blender (datafiles/studiolights/world), a sun alone and under a sky, one bright pixel, a uniform sky.
Each is baked by the automatic choice and by the preset's own order, and its error budget measured by path tracing with
all bounces: what the basis loses, what compression adds, and all together with sampling.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "2")  # before numpy loads

import numpy as np
from common import print_table
from eigentransport import upright

from prt_addon.baking.basis_choice import choose_basis
from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import BakeSettings, make_settings
from prt_addon.lighting.environment import load_equirectangular, pixel_of_direction
from prt_addon.lighting.reference_light import ReferenceLight
from prt_addon.reporting.wording import memory
from prt_addon.scene.scene_mesh import SceneMesh
from tests.core.shapes import plane

WORLDS = ("studio", "interior", "forest", "city", "sunset")
SUN = np.array([0.5, 0.3, 0.8]) / np.linalg.norm([0.5, 0.3, 0.8])


def worlds_folder() -> Path:
    """Where Blender's own HDRIs lie."""
    import bpy

    return Path(bpy.utils.resource_path("LOCAL")) / "datafiles" / "studiolights" / "world"


def lights() -> dict[str, ReferenceLight]:
    """All lights by name."""
    folder = worlds_folder()
    found = {name: ReferenceLight.of(load_equirectangular(folder / f"{name}.exr"), None, [], name) for name in WORLDS}
    sun = (SUN, np.full(3, 3.0), np.radians(0.526))
    pixel = np.zeros((64, 128, 3), np.float32)
    pixel[pixel_of_direction(SUN[None], 64, 128)] = 1000.0
    found["sun alone"] = ReferenceLight.of(np.zeros((64, 128, 3), np.float32), None, [sun], "sun")
    found["sun, sky"] = ReferenceLight.of(np.full((64, 128, 3), 0.3, np.float32), None, [sun], "sun and sky")
    found["one pixel"] = ReferenceLight.of(pixel, None, [], "one pixel")
    found["uniform"] = ReferenceLight.of(np.ones((64, 128, 3), np.float32), None, [], "uniform")
    return found


def baked_row(scene: SceneMesh, settings: BakeSettings, light: ReferenceLight) -> list:
    """Measured errors of basis, compression and all, bytes, and seconds without those of measuring."""
    started = time.perf_counter()
    result = exhaust(bake(scene, settings, light=light))
    seconds = time.perf_counter() - started - sum(
        stage["seconds"] for stage in result.report["stages"] if stage["name"] == "errors")
    errors = [100.0 * result.report["errors"][name]["relative_rms"] for name in ("basis", "compression", "total")]
    size = sum(o.bases.nbytes + o.weights.nbytes for o in result.objects.values())
    return [*errors, memory(size), seconds]


def main() -> None:
    """Print the table, row by row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", default="spot.obj")
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--receivers", type=int, default=96)
    parser.add_argument("--cells", type=int, default=64, help="of the ground, along an edge")
    parser.add_argument("--only", default="", help="a light")
    options = parser.parse_args()
    model = upright(options.mesh)
    size = 3.0 * float(np.ptp(model.positions, axis=0).max())
    scene = SceneMesh.assemble([model, plane(size=size, cells=options.cells, albedo=(0.7, 0.7, 0.7))])
    more = {"spacing": "0", "error_receivers": str(options.receivers), "error_paths": "16384"}
    plain = make_settings(options.preset, more)
    automatic = replace(plain, distant_basis="auto", encoder="auto")
    rows = []
    for name, light in lights().items():
        if options.only in name:
            chosen, choice = choose_basis(scene, automatic, light)
            found = choice.facts["chosen"]
            text = f"order {chosen.order}" if chosen.distant_basis == "sh" else \
                f"cubemap {chosen.cubemap_size}, {chosen.encoder} {chosen.vectors}"
            rows.append([name, text, 100.0 * found["basis_error"], 100.0 * found["encoder_error"],
                         *baked_row(scene, chosen, light)])
            rows.append([name, f"order {plain.order}", "", "", *baked_row(scene, plain, light)])
            print(rows[-2], rows[-1], flush=True)
    print_table(["light", "sky by", "predicted: basis %", "encoder %", "measured: basis %", "compression %", "all %",
                 "data", "s"], rows)


if __name__ == "__main__":
    main()
