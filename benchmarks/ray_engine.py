# SPDX-License-Identifier: GPL-3.0-or-later
"""The ray engine (Carr, Hall & Hart 2002) against Embree, through Blender's GPU module; or exported for a real GPU.

    python benchmarks/ray_engine.py [--rays 300000] [--threads 2]      with the bpy wheel, any driver
    python benchmarks/ray_engine.py --export DIR                      then there: python3 device_ray_engine.py

The second form writes kernels as plain GLSL, three scenes, and a script that needs neither Blender nor this checkout.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import types
from dataclasses import asdict
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from common import ROOT, print_table
from numpy.typing import NDArray
from ray_measurements import (
    MODEL_HEADER,
    RATES_HEADER,
    SWEEP_HEADER,
    Agreement,
    Embree,
    add_agreement,
    agreement,
    make_rays,
    model_rows,
    rates,
    sweep,
)
from ray_scenes import scenes

from prt_addon.tracing.ray_calibration import calibrate
from prt_addon.tracing.ray_engine import RayEngine

COPIED = ("__init__.py", "errors.py", "tracing/__init__.py", "tracing/bounding_hierarchy.py", "tracing/hits.py",
          "tracing/ray_buckets.py", "tracing/ray_calibration.py", "tracing/ray_cost.py", "tracing/ray_engine.py")


def use_checkout_as_package() -> None:
    """Make `prt.gpu_shaders` importable: its relative imports need the root as a package, as in the extension."""
    package = types.ModuleType("prt")
    package.__path__ = [str(ROOT)]
    sys.modules["prt"] = package


def export(folder: Path) -> None:
    """Everything that a machine without Blender needs, below `folder`."""
    from prt.gpu_shaders.ray_programs import PROGRAMS
    for part in ("kernels", "scenes", "prt_addon/tracing"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    entries = []
    for (kernel, occluded), program in PROGRAMS.items():
        name = f"{kernel}{'_occluded' if occluded else ''}.glsl"
        (folder / "kernels" / name).write_text(program.glsl())
        entries.append({"kernel": kernel, "occluded": occluded, "file": name, "samplers": program.samplers})
    (folder / "kernels" / "kernels.json").write_text(json.dumps(entries, indent=1))
    for name in COPIED:
        shutil.copy(ROOT / "prt_addon" / name, folder / "prt_addon" / name)
    for name in ("ray_measurements.py", "device_ray_engine.py"):
        shutil.copy(Path(__file__).with_name(name), folder / name)
    for scene in scenes().values():
        np.savez_compressed(folder / "scenes" / f"{scene.name.replace(' ', '_')}.npz", **vars(scene))
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    print(f"{folder}: {size / 1e6:.1f} MB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--export", type=Path)
    parser.add_argument("--rays", type=int, default=300_000, help="traced twice for the comparison, over all scenes")
    parser.add_argument("--rate-rays", type=int, default=100_000)
    parser.add_argument("--sweep-rays", type=int, default=16_384)
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    use_checkout_as_package()
    if arguments.export:
        export(arguments.export)
        return
    from prt.gpu_shaders.offscreen import prepare_gpu
    from prt.gpu_shaders.ray_device import BlenderDevice
    prepare_gpu()
    device = BlenderDevice()
    print(f"{device.name}, Embree on {arguments.threads} threads\n")

    def embree_of(points: NDArray[np.float32], triangles: NDArray[np.int32]) -> Any:
        traced = Embree(points, triangles, arguments.threads)
        return lambda origins, directions: traced.occluded_where(
            origins, directions, np.ones((len(directions), len(origins)), bool))
    known = calibrate(device, embree_of, arguments.threads)
    print_table(["constant", "value"], [[k, v] for k, v in asdict(known).items()])
    made = scenes()
    engines = {name: RayEngine(device, scene.points, scene.triangles) for name, scene in made.items()}
    embrees = {name: Embree(scene.points, scene.triangles, arguments.threads) for name, scene in made.items()}
    print()
    print_table(RATES_HEADER,
                [row for name, scene in made.items() for row in rates(scene, engines[name], embrees[name],
                                                                      arguments.rate_rays)])
    print()
    print_table(MODEL_HEADER, model_rows(next(iter(engines.values())), known, [64, 256, 4096], [4, 16, 64, 256]))
    print()
    rows = []
    for name, scene in made.items():
        for kind in ("parallel", "gather"):
            rows += sweep(scene, engines[name], known, kind, arguments.sweep_rays, [64, 256, 512], [16],
                          known.embree_rays)
            rows += sweep(scene, engines[name], known, kind, arguments.sweep_rays, [256], [4, 64], known.embree_rays)
    print_table(SWEEP_HEADER, rows)
    print()
    rows = []
    for name, scene in made.items():
        found = agreement(scene, engines[name], embrees[name], arguments.rays // len(made))
        rows.append([name, "traversal", *asdict(found).values()])
        cells = Agreement()
        for kind in ("parallel", "gather"):
            for batch in make_rays(scene, kind, arguments.sweep_rays, 21):
                add_agreement(cells, scene, engines[name], embrees[name], *batch,
                              lambda o, d, e=engines[name]: e.cells_nearest(o, d, 256, 16))
        rows.append([name, "cells", *asdict(cells).values()])
    print_table(["scene", "kernel", *asdict(Agreement())], rows)
    for name, engine in engines.items():
        record = engine.record
        print(f"{name}: {record.count} slices, longest {1e3 * record.longest:.0f} ms, mean "
              f"{1e3 * record.seconds / record.count:.0f} ms")


if __name__ == "__main__":
    main()
