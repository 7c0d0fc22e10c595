# SPDX-License-Identifier: GPL-3.0-or-later
"""Milliseconds per light change and per frame of compressed glossy transfer, beside uncompressed matrices. Needs the
bpy wheel and a graphics driver (Mesa's software driver serves).

    python benchmarks/drawing.py [--mesh buddha_nirj.obj] [--rows 25] [--clusters 256] [--vectors 8] [--size 1280x720]

Matrices of made-up numbers: only their sizes count. `uncompressed`: M_p light of every receiver as one product.
The paper's frame rates were 16 to 20 times those of uncompressed transfer.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the paper: one processor

import bpy
import numpy as np
from common import ROOT, best_of, load_obj, mesh_path, print_table, smooth_object

from prt_addon.basis.hemisphere import functions_of
from prt_addon.linear_algebra import multiply
from prt_addon.relighting.exit_radiance import cluster_constants, exit_radiance
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.storage.container import CONSTANT_ROWS, BakedTransfer, hemisphere_rows, make_header

assert bpy.app.background, ROOT


def made_up(scene: SceneMesh, rows: int, columns: int, clusters: int, vectors: int) -> BakedTransfer:
    """A bake of the mesh with random numbers; rows 0: diffuse."""
    generator = np.random.default_rng(0)
    shape = (clusters, vectors + 1, rows + 1, columns, 1)
    count = len(scene.points)
    header = make_header(shape, {"kind": "spherical_harmonics", "order": round(columns ** 0.5)},
                         hemisphere_rows(functions_of(rows).tolist()) if rows else CONSTANT_ROWS)
    return BakedTransfer(header, generator.integers(0, clusters, count).astype(np.int32),
                         generator.standard_normal((count, vectors), np.float32),
                         generator.standard_normal(shape, np.float32), np.full((count, 3), 0.5, np.float32),
                         scene.points.astype(np.float32), scene.normals.astype(np.float32), scene.triangles,
                         scene.tangents.astype(np.float32) if rows else None)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", default="buddha_nirj.obj")
    parser.add_argument("--rows", type=int, default=25)
    parser.add_argument("--clusters", type=int, default=256)
    parser.add_argument("--vectors", type=int, default=8)
    parser.add_argument("--size", default="1280x720")
    arguments = parser.parse_args()
    scene = SceneMesh.assemble([smooth_object("mesh", *load_obj(mesh_path(arguments.mesh)), (0.5, 0.5, 0.5))])
    light = np.random.default_rng(1).standard_normal((25, 3)).astype(np.float32)
    baked = made_up(scene, arguments.rows, 25, arguments.clusters, arguments.vectors)
    count, rows = len(scene.points), arguments.rows + 1
    whole = np.random.default_rng(2).standard_normal((count * rows, 25), np.float32)
    plain, _ = best_of(5, lambda: multiply(whole, light))
    packed, _ = best_of(5, lambda: exit_radiance(baked.cluster, baked.weights, cluster_constants(baked.bases, light)))
    print_table(["receivers", "rows x columns", "uncompressed MB", "compressed MB", "uncompressed ms", "compressed ms"],
                [[count, f"{rows} x 25", whole.nbytes / 1e6, (baked.bases.nbytes + baked.weights.nbytes) / 1e6,
                  1e3 * plain, 1e3 * packed]])
    frames(scene, baked, made_up(scene, 0, 25, arguments.clusters, arguments.vectors), light,
           *map(int, arguments.size.split("x")))


def frames(scene: SceneMesh, glossy: BakedTransfer, diffuse: BakedTransfer, light: np.ndarray, width: int,
           height: int) -> None:
    """Light changes and frames on the GPU."""
    import sys
    import types

    package = types.ModuleType("prt")  # gpu_shaders imports the core relatively, as in the installed extension
    package.__path__ = [str(ROOT)]
    sys.modules["prt"] = package
    from prt.gpu_shaders import draw, offscreen, render_data

    offscreen.prepare_gpu()
    low, high = scene.points.min(axis=0), scene.points.max(axis=0)
    transform = np.eye(4)
    transform[:3, :3] = np.diag(1.9 / (high - low).max() * np.array([height / width, 1.0, -0.5]))
    transform[:3, 3] = -transform[:3, :3] @ (0.5 * (low + high))
    table = []
    with offscreen._offscreen(width, height) as target:
        for name, baked in (("glossy", glossy), ("diffuse", diffuse)):
            drawing = draw.ObjectDrawing(render_data.make_render_data(baked))
            constants = cluster_constants(baked.bases, light)

            def relight(drawing=drawing, constants=constants):  # noqa: ANN001, ANN202
                drawing.relight(constants)
                drawing.exit_radiances()  # waits for the GPU

            def frame(drawing=drawing):  # noqa: ANN001, ANN202
                drawing.draw(transform)
                draw.read_texture(target.texture_color)

            relit, _ = best_of(5, relight)
            drawn, _ = best_of(5, frame)
            empty, _ = best_of(5, lambda: draw.read_texture(target.texture_color))
            table.append([name, 1e3 * relit, 1e3 * drawn, 1e3 * empty])
    print_table(["bake", "GPU: light change and read back ms", f"frame {width}x{height} and read back ms",
                 "reading back alone ms"], table)


if __name__ == "__main__":
    main()
