# SPDX-License-Identifier: GPL-3.0-or-later
"""The ray engine on a real GPU by moderngl, without Blender: run where `ray_engine.py --export` has put it.

    python3 device_ray_engine.py [--rays 10000000] [--seconds 110] [--output results.json]

Needs numpy and moderngl with EGL; compares with embreex (all cores) where that is installed. Prints Markdown tables.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))  # the exported copies beside this file

import moderngl
import numpy as np
from numpy.typing import NDArray
from ray_measurements import (
    MODEL_HEADER,
    RATES_HEADER,
    SWEEP_HEADER,
    Agreement,
    Embree,
    Scene,
    add_agreement,
    agreement,
    make_rays,
    model_rows,
    rates,
    sweep,
)

from prt_addon.tracing.ray_calibration import calibrate
from prt_addon.tracing.ray_engine import RayEngine


class ModernglDevice:
    """A RayDevice over moderngl."""

    def __init__(self, kernels: Path) -> None:
        try:
            self.context = moderngl.create_context(standalone=True, backend="egl", require=430, libgl="libGL.so.1",
                                                   libegl="libEGL.so.1")
        except Exception:
            self.context = moderngl.create_context(standalone=True, backend="egl", require=430)
        self.name = self.context.info["GL_RENDERER"]
        self.version = self.context.info["GL_VERSION"]
        self._programs: dict[tuple[str, bool], tuple[Any, list[str]]] = {}
        for entry in json.loads((kernels / "kernels.json").read_text()):
            program = self.context.compute_shader((kernels / entry["file"]).read_text())
            self._programs[entry["kernel"], entry["occluded"]] = (program, entry["samplers"])

    def upload(self, texels: NDArray[np.float32]) -> Any:
        """A texture of (height, width, 4) values."""
        height, width, _ = texels.shape
        return self._nearest(self.context.texture((width, height), 4, np.ascontiguousarray(texels), dtype="f4"))

    def empty(self, width: int, height: int) -> Any:
        """A texture to write."""
        return self._nearest(self.context.texture((width, height), 4, dtype="f4"))

    @staticmethod
    def _nearest(texture: Any) -> Any:
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return texture

    def run(self, kernel: str, occluded: bool, textures: dict[str, Any], answers: Any, constants: dict[str, int],
            groups: int) -> None:
        """Start a kernel."""
        program, samplers = self._programs[kernel, occluded]
        for slot, name in enumerate(samplers):
            textures[name].use(location=slot)
        answers.bind_to_image(0, read=False, write=True)
        for name, value in constants.items():
            program[name] = value
        program.run(groups)
        self.context.memory_barrier()

    def read(self, texture: Any) -> NDArray[np.float32]:
        """Its values."""
        return np.frombuffer(texture.read(), np.float32).reshape(texture.height, texture.width, 4)


def print_table(title: str, header: list[str], rows: list[list[Any]]) -> None:
    """A Markdown table."""
    def cell(value: Any) -> str:
        return f"{value:.4g}" if isinstance(value, float) else str(value)
    print(f"\n### {title}\n\n| " + " | ".join(header) + " |\n|" + " --- |" * len(header))
    for row in rows:
        print("| " + " | ".join(map(cell, row)) + " |")
    sys.stdout.flush()


def load_scenes() -> list[Scene]:
    """The exported scenes."""
    found = []
    for path in sorted((HERE / "scenes").glob("*.npz")):
        stored = np.load(path)
        found.append(Scene(str(stored["name"]), *(np.ascontiguousarray(stored[k]) for k in (
            "points", "triangles", "origins", "normals"))))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rays", type=int, default=10_000_000, help="traced twice for the comparison, over all scenes")
    parser.add_argument("--rate-rays", type=int, default=2_000_000)
    parser.add_argument("--sweep-rays", type=int, default=65_536)
    parser.add_argument("--seconds", type=float, default=110.0, help="after which what is left is left out")
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    began = time.perf_counter()
    device, scenes, results = ModernglDevice(HERE / "kernels"), load_scenes(), {}
    threads = len(os.sched_getaffinity(0))
    try:
        import embreex  # noqa: F401
    except ImportError:
        print("embreex is not installed: nothing is compared")
        embrees = dict.fromkeys(scene.name for scene in scenes)
    else:
        embrees = {scene.name: Embree(scene.points, scene.triangles) for scene in scenes}

    def left(share: float) -> float:
        """Seconds that one of the parts that follow may take."""
        return max(0.0, arguments.seconds - (time.perf_counter() - began)) * share

    def embree_of(points: NDArray[np.float32], triangles: NDArray[np.int32]) -> Any:
        if embrees[scenes[0].name] is None:
            return lambda *_: time.sleep(1.0)
        traced = Embree(points, triangles)
        return lambda origins, directions: traced.occluded_where(
            origins, directions, np.ones((len(directions), len(origins)), bool))
    print(f"device: {device.name}, {device.version}; {threads} CPU threads")
    known = calibrate(device, embree_of, threads)
    print_table("Calibration", ["constant", "value"], [[k, v] for k, v in asdict(known).items()])
    results["calibration"] = asdict(known)
    engines = {}
    for scene in scenes:
        started = time.perf_counter()
        engines[scene.name] = RayEngine(device, scene.points, scene.triangles)
        print(f"{scene.name}: {len(scene.triangles)} triangles, tree of {engines[scene.name].tree.levels} levels in "
              f"{time.perf_counter() - started:.2f} s")
    print(f"at {time.perf_counter() - began:.0f} s")

    results["rates"] = [row for scene in scenes for row in rates(scene, engines[scene.name], embrees[scene.name],
                                                                 arguments.rate_rays)]
    print_table("Rays per second, traversal", RATES_HEADER, results["rates"])
    print(f"at {time.perf_counter() - began:.0f} s")

    if embrees[scenes[0].name]:
        rows = []
        for index, scene in enumerate(scenes):
            found = agreement(scene, engines[scene.name], embrees[scene.name], arguments.rays // len(scenes),
                              left(0.5 / (len(scenes) - index)))
            rows.append([scene.name, "traversal", *asdict(found).values()])
            small = Agreement()
            for kind in ("parallel", "gather"):
                for batch in make_rays(scene, kind, arguments.sweep_rays, 21):
                    add_agreement(small, scene, engines[scene.name], embrees[scene.name], *batch,
                                  lambda o, d, e=engines[scene.name]: e.cells_nearest(o, d, 256, 64))
            rows.append([scene.name, "cells", *asdict(small).values()])
        print_table("Agreement with Embree", ["scene", "kernel", *asdict(Agreement())], rows)
        results["agreement"] = rows
        print(f"at {time.perf_counter() - began:.0f} s")

    results["model"] = model_rows(engines[scenes[0].name], known, [64, 256, 4096, 65536, 262144],
                                  [4, 16, 64, 256, 1024])
    print_table("All pairs of R rays and T triangles in one dispatch, answers read back: model against measurement "
                "(Figure 7)", MODEL_HEADER, results["model"])
    print(f"at {time.perf_counter() - began:.0f} s")

    results["sweep"] = []
    for scene in scenes:
        for kind in ("parallel", "gather"):
            for bucket_rays, triangles in (([64, 128, 256, 512], [16]), ([256], [4, 64, 256])):
                if left(1.0) <= 0.0:
                    continue
                results["sweep"] += sweep(scene, engines[scene.name], known, kind, arguments.sweep_rays, bucket_rays,
                                          triangles, known.embree_rays)
    print_table("Buckets against cells, as published (Tables 4 and 5)", SWEEP_HEADER, results["sweep"])
    print(f"at {time.perf_counter() - began:.0f} s")

    longest = {name: (engine.record.longest, engine.record.count, engine.record.seconds / max(1, engine.record.count))
               for name, engine in engines.items()}
    print("\nslices, transfers included: " + "; ".join(
        f"{name}: {count}, longest {1e3 * long:.1f} ms, mean {1e3 * mean:.1f} ms" for name, (long, count, mean)
        in longest.items()))
    results["slices"] = longest
    print(f"done at {time.perf_counter() - began:.0f} s")
    if arguments.output:
        arguments.output.write_text(json.dumps({"device": device.name, "threads": threads, **results}, indent=1,
                                               default=float))


if __name__ == "__main__":
    main()
