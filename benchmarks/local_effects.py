# SPDX-License-Identifier: GPL-3.0-or-later
"""What each choice of a bake of local lights does, on the paper's Cornell box. Needs the bpy wheel.

    python benchmarks/local_effects.py [vectors columns density zones merging wall door] [--docs]

Errors are relative RMS over vertices and channels of the bounced light, against our own solution at 20 held-back places
of a lamp (no Cycles: what the operator's rays cost is not in them), root mean square over places. `wall`: the share of
the light that leaks through a thin wall, with the visibility rays of section 6 and without; `door`: the largest change
from one frame to the next (30 a second) while a lamp passes through a door, of the picture's root mean square.
--docs writes the tables to docs/local_lights.md and plots beside it.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the bake's process; before numpy loads

import itertools

import bpy
import local_lights
import local_scenes
import numpy as np
from common import ROOT, markdown_table, save_plot, write_block
from numpy.typing import NDArray

from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import make_settings
from prt_addon.relighting.exit_radiance import cluster_constants, exit_radiance
from prt_addon.relighting.lamp_light import LampLight, lamps_in, unit_lamp
from prt_addon.relighting.scene_light import joined_light
from prt_addon.reporting.svg_plots import Curve, curves
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from tests.core.shapes import box as room_mesh
from tests.core.shapes import make

DOCS = ROOT / "docs"
COMMON = {"lighting": "local", "cloud_emission": "1", "gather_directions": "1024", "error_receivers": "0",
          "clusters": "64", "vectors": "12", "encoder": "adaptive", "cloud_lights": "216", "merge_response": "0.02",
          "zone_receivers": "400"}
CLEARANCE = 1.0 / 6.0  # half the spacing of the paper's cloud of 216 lights


def measured(overrides: dict[str, str]) -> tuple[float, float, float, dict]:
    """Percent of error: of the columns, of compression, of both; and the report."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    thing, bounds = local_scenes.SCENES["cornell"]()
    kept = local_lights.baked(thing, bounds, make_settings("standard", COMMON | overrides))
    lamp = lamps_in(kept.baked.cloud, kept.solver.tracer)
    found = []
    for place in local_lights.held_back(kept.solver.tracer, bounds, 20, CLEARANCE):
        exact, columns, drawn = (light[kept.visible] for light in local_lights.ours(kept, lamp, place))
        found.append([np.sum((columns - exact) ** 2), np.sum((drawn - columns) ** 2), np.sum((drawn - exact) ** 2)]
                     / np.sum(exact ** 2))
    return *(100.0 * np.sqrt(np.mean(found, axis=0))), {**kept.report, "bake": kept.seconds}


def swept(name: str, values: list, others: dict[str, str], facts: Callable[[dict], list]) -> list[list]:
    """A line for each value of a setting."""
    lines = []
    for value in values:
        columns, compression, both, report = measured(others | {name: str(value)})
        lines.append([value, *facts(report), columns, compression, both, report["bake"]])
        print(name, lines[-1], flush=True)
    return lines


def vectors(docs: bool) -> str:
    """Error against the number of vectors, of both bases."""
    counts = [1, 2, 4, 6, 8, 12, 16, 24]
    lines, plot = [], []
    for basis in ("surfaces", "cloud"):
        rows = swept("vectors", counts, {"lamp_basis": basis}, lambda report: [report["clusters"]["vectors_mean"]])
        lines += [[basis, *row] for row in rows]
        plot += [Curve(f"{basis}: compression", [(row[1], row[3] / 100.0) for row in rows]),
                 Curve(f"{basis}: all", [(row[1], row[4] / 100.0) for row in rows])]
    if docs:
        save_plot(DOCS / "local_vectors.svg", curves(plot, "vectors of a vertex, mean", "relative RMS",
                                                     "Cornell box: error against vectors"))
    return markdown_table(["columns of", "vectors", "mean", "columns %", "compression %", "all %", "bake s"], lines)


def columns(docs: bool) -> str:
    """Error against columns and patches of lit surfaces."""
    lines = [["columns", *row] for row in swept("surface_columns", [32, 64, 128, 256, 384, 512], {},
                                                lambda report: [report["local"]["columns"]])]
    lines += [["patches", *row] for row in swept("surface_patches", [128, 256, 512, 1024, 2048, 4096], {},
                                                 lambda report: [report["local"]["columns"]])]
    return markdown_table(["of lit surfaces", "at most", "columns", "columns %", "compression %", "all %", "bake s"],
                          lines)


def density(docs: bool) -> str:
    """Error against the density of the light cloud."""
    rows = swept("cloud_lights", [27, 64, 125, 216, 343, 512, 1000], {"lamp_basis": "cloud", "merge_response": "0"},
                 lambda report: [report["local"]["lights"], report["local"]["spacing"]])
    if docs:
        save_plot(DOCS / "local_density.svg", curves(
            [Curve("cloud", [(r[1], r[3] / 100.0) for r in rows]), Curve("all", [(r[1], r[5] / 100.0) for r in rows])],
            "lights of the cloud", "relative RMS", "Cornell box: error against the cloud's density", log_x=True))
    return markdown_table(["at most", "lights", "spacing m", "columns %", "compression %", "all %", "bake s"], rows)


def zones(docs: bool) -> str:
    """Zones: fewer lights each."""
    rows = swept("zone_receivers", [0, 1600, 800, 400, 200], {"lamp_basis": "cloud"},
                 lambda report: [report["local"]["zones"], float(np.mean(report["local"]["merged"])),
                                 report["clusters"]["count"]])
    return markdown_table(["receivers of a zone", "zones", "lights kept, mean", "clusters", "columns %",
                           "compression %", "all %", "bake s"], rows)


def merging(docs: bool) -> str:
    """Clustering of lights: those kept against error, in each mode."""
    lines = []
    for mode in ("arithmetic", "harmonic", "solution"):
        lines += [[mode, *row] for row in swept(
            "merge_response", [0, 0.01, 0.02, 0.05, 0.1, 0.3], {"lamp_basis": "cloud", "merged_response": mode},
            lambda report: [float(np.mean(report["local"]["merged"]))])]
    return markdown_table(["merged by", "merge_response", "lights kept, mean", "columns %", "compression %", "all %",
                           "bake s"], lines)


def parted(opening: float, basis: str) -> tuple[object, SceneMesh]:
    """A unit room parted by a thin wall at x = 0.5 with a door of this width, baked."""
    wall = [(0.5, opening, 0), (0.5, 1, 0), (0.5, 1, 1), (0.5, opening, 1)]
    meshes = [room_mesh("room", inward=True, albedo=(0.7, 0.5, 0.3)),
              make("wall", wall, [(0, 1, 2), (0, 2, 3)], albedo=(0.6, 0.6, 0.6), target=False)]
    scene = SceneMesh.assemble(meshes, 0.05, np.array([[0.4, 0.5, 0.5]]))
    settings = make_settings("standard", COMMON | {"lamp_basis": basis, "cloud_lights": "125", "threads": "1"})
    return exhaust(bake(scene, settings)).objects["room"], scene


def shown(baked: object, values: NDArray[np.float32]) -> NDArray[np.float64]:
    """Bounced light (points, 3), unit albedo."""
    constants = cluster_constants(baked.bases, joined_light(baked.lighting_basis, None, values), baked.cluster_zone)
    return exit_radiance(baked.cluster, baked.weights, constants)[:, 0].astype(np.float64)


def wall(docs: bool) -> str:
    """Light that leaks through a wall."""
    lines = []
    for basis in ("surfaces", "cloud"):
        baked, scene = parted(0.0, basis)
        here, beyond = baked.positions[:, 0] < 0.44, baked.positions[:, 0] > 0.56
        for name, triangles in (("with", scene.triangles), ("without", scene.triangles[:0])):
            if basis == "surfaces" and name == "without":
                continue  # nothing is left of the method without shadow rays
            lamps = lamps_in(baked.cloud, Tracer(scene.points, triangles, 1))
            for distance in (0.25, 0.1, 0.04):
                light = shown(baked, lamps.step([unit_lamp(np.array([0.5 - distance, 0.5, 0.5]), "lamp")]).values)
                lines.append([basis, name, distance, 100.0 * light[beyond].mean() / light[here].mean()])
    return markdown_table(["columns of", "visibility rays", "lamp before the wall, m", "light beyond it, % of here"],
                          lines)


def door(docs: bool) -> str:
    """The largest jump from frame to frame while a lamp passes through a door at 0.5 m/s."""
    lines = []
    for basis, fade in (("surfaces", 0.0), ("cloud", 0.0), ("cloud", 0.3)):
        baked, scene = parted(0.3, basis)
        tracer = Tracer(scene.points, scene.triangles, 1)
        lamps = lamps_in(baked.cloud, tracer) if basis == "surfaces" else LampLight(baked.cloud, tracer,
                                                                                     fade_seconds=fade)
        pictures = [shown(baked, lamps.step([unit_lamp(np.array([x, 0.15, 0.5]), "lamp")], 1.0 / 30.0).values)
                    for x in np.arange(0.25, 0.75, 0.5 / 30.0)]
        whole = np.sqrt(np.mean(np.square(pictures)))
        steps = [np.sqrt(np.mean((b - a) ** 2)) / whole for a, b in itertools.pairwise(pictures)]
        lines.append([basis, fade, 100.0 * max(steps[1:]), 100.0 * float(np.median(steps[1:]))])
    return markdown_table(["columns of", "fading s", "largest step, %", "median step, %"], lines)


PARTS = {"vectors": vectors, "columns": columns, "density": density, "zones": zones, "merging": merging, "wall": wall,
         "door": door}


def main() -> None:
    """Parse the command line and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}; all by default")
    parser.add_argument("--docs", action="store_true", help="also write docs/local_lights.md and plots")
    options = parser.parse_args()
    for name in options.parts or PARTS:
        table = PARTS[name](options.docs)
        print(f"\n{name}\n\n{table}", flush=True)
        if options.docs:
            write_block(DOCS / "local_lights.md", f"local {name}", table)


if __name__ == "__main__":
    main()
