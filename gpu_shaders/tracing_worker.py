# SPDX-License-Identifier: GPL-3.0-or-later
"""The child process in which a graphics driver traces rays: run by path, by Blender or by a Python with `bpy`.

    blender --background --factory-startup --python tracing_worker.py -- bake JOB SITE
    blender --background --factory-startup --python tracing_worker.py -- measure JOB SITE

JOB: the folder of a bake (baking/job.py), or an empty one, in which calibration.json is left; SITE: where wheels lie.
Messages are those of a bake's child (baking/worker.py), in the same file. A child of its own, so that a driver that
falls takes no artist's file along, and that the artist's Blender stays as it is; its slices leave the GPU to the
viewport in between. It is no part of the extension while it starts: it makes a package of the folder above it.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "prt_traced"


def load_worker() -> types.ModuleType:
    """The bake's child, for its messages and its end with the parent. By its path: no package is loaded yet."""
    spec = importlib.util.spec_from_file_location("prt_worker", ROOT / "prt_addon" / "baking" / "worker.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


worker = load_worker()


def part(name: str) -> types.ModuleType:
    """A module of the extension."""
    if PACKAGE not in sys.modules:
        package = types.ModuleType(PACKAGE)
        package.__path__ = [str(ROOT)]
        sys.modules[PACKAGE] = package
    return importlib.import_module(f"{PACKAGE}.{name}")


def make_device() -> Any:
    """The graphics driver, ready to compute. It ends the process where there is none, which the parent reports."""
    import bpy  # noqa: F401  in a plain Python it is what brings the module below
    import gpu

    gpu.init()
    return part("gpu_shaders.ray_device").BlenderDevice()


def tracer_maker(device: Any) -> Callable[..., Any]:
    """Makes what traces a bake: on the device beside Embree, or by Embree alone where the device can't hold it."""
    errors, mixed = part("prt_addon.errors"), part("prt_addon.tracing.mixed_tracer")

    def make(points: Any, triangles: Any, threads: int, surface: Any = None) -> Any:
        try:
            return mixed.MixedTracer(points, triangles, threads, device, surface)
        except errors.PRTError:
            return part("prt_addon.tracing.tracer").Tracer(points, triangles, threads, surface)
    return make


def measure(job: Path) -> int:
    """Measure this machine's graphics driver and its Embree. Returns the exit status."""
    calibration, tracer = part("prt_addon.tracing.ray_calibration"), part("prt_addon.tracing.tracer")
    files = part("prt_addon.storage.files")
    worker.emit("progress", stage="measure", fraction=0.0, rays=0, seconds_left=None)
    made = []

    def embree(points: Any, triangles: Any) -> Callable[[Any, Any], Any]:
        made.append(tracer.Tracer(points, triangles))

        def trace(origins: Any, directions: Any) -> None:
            for _ in made[0].map_in_order(lambda k: made[0].occluded(origins, directions[k:k + 1]),
                                          range(len(directions))):
                pass
        return trace
    found = calibration.calibrate(make_device(), embree, tracer.Tracer(*calibration.ball_field()).threads)
    files.write_atomically(job / "calibration.json", lambda stream: stream.write(found.to_json().encode()))
    worker.emit("done")
    return 0


def main() -> int:
    verb, job, site = sys.argv[sys.argv.index("--") + 1:][:3]
    folder = Path(job)
    sys.stdout = open(folder / "messages.jsonl", "a", encoding="utf-8")  # noqa: SIM115  Blender writes to descriptor 1
    worker.use_wheels(site)
    worker.be_polite()
    leftovers = part("prt_addon.baking.leftovers")

    def clean_up() -> None:
        leftovers.drop_unfinished(folder)

    worker.die_with_parent(clean_up)
    if verb == "measure":
        return measure(folder)
    return worker.run_or_give_up(folder, clean_up, leftovers.CANT_WRITE, f"{PACKAGE}.prt_addon",
                                 make_tracer=tracer_maker(make_device()))


if __name__ == "__main__":
    sys.exit(main())
