# SPDX-License-Identifier: GPL-3.0-or-later
"""Error against run time of whole bakes: directions, gather rays and encoder varied, everything measured in one run.

    python benchmarks/error_against_time.py [--mesh buddha_nirj.obj] [--plot docs/error_against_time.svg]

The error is the bake's own budget: relative RMS of exit radiance at random receivers against independent path tracing,
under a stand-in sky. Seconds are without the budget's own time.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the bake's process; before numpy loads

from common import ROOT, load_obj, mesh_path, print_table, save_plot, smooth_object

from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import PRESETS, BakeSettings
from prt_addon.reporting.svg_plots import Curve, curves
from prt_addon.scene.scene_mesh import SceneMesh


def run(scene: SceneMesh, label: str, settings: BakeSettings) -> list[object]:
    """One row: label, seconds without the error budget, and the four errors in percent."""
    report = exhaust(bake(scene, settings)).report
    seconds = sum(stage["seconds"] for stage in report["stages"] if stage["name"] != "errors")
    errors = report["errors"]
    return [label, seconds, *(100.0 * errors[name]["relative_rms"]
                              for name in ("sampling", "basis", "compression", "total"))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", default="buddha_nirj.obj")
    parser.add_argument("--plot", type=Path)
    arguments = parser.parse_args()
    positions, triangles = load_obj(mesh_path(arguments.mesh))
    scene = SceneMesh.assemble([smooth_object("mesh", positions, triangles, (0.7, 0.5, 0.3))])
    base = replace(PRESETS["standard"], spacing=0.0, error_receivers=128, error_paths=16384, compression_error=0.0)
    sampling = [run(scene, f"{d} directions", replace(base, directions=d, gather_directions=d // 8, encoder="static"))
                for d in (256, 512, 1024, 2048, 4096)]
    encoders = [run(scene, f"{e}, {c} clusters", replace(base, directions=1024, encoder=e, clusters=c))
                for e in ("static", "iterative", "adaptive") for c in (64, 256)]
    presets = [run(scene, name, replace(PRESETS[name], spacing=0.0, error_receivers=128, error_paths=16384))
               for name in PRESETS]
    print_table(["setting", "seconds", "sampling %", "basis %", "compression %", "total %"],
                sampling + encoders + presets)
    if arguments.plot:
        drawn = [Curve("sampling, by directions", [(row[1], row[2] / 100.0) for row in sampling]),
                 Curve("total, by preset", [(row[1], row[5] / 100.0) for row in presets])]
        drawn += [Curve(f"compression, {e}", [(row[1], row[4] / 100.0) for row in encoders if row[0].startswith(e)])
                  for e in ("static", "iterative", "adaptive")]
        picture = curves(drawn, "seconds", "relative RMS error", f"Error against run time, {arguments.mesh}")
        save_plot(ROOT / arguments.plot, picture)


if __name__ == "__main__":
    main()
