# SPDX-License-Identifier: GPL-3.0-or-later
"""Frame time of the preview beside the plain viewport, and the time from a change of light to the picture, in a real
Blender with its interface.

    python benchmarks/preview_frames.py --zip prt-linux-x64.zip --ui "COMMAND" --headless "COMMAND" [--side 224]
        [--frames 12] [--rounds 4] [--gpu-backend vulkan]

COMMAND starts Blender as in tests/interface/run.py. A bumpy field of side x side receivers is baked (diffuse); then the
view orbits, preview on and off by turns in one run, in solid and in material shading, and a Sun turns. Software drivers
and loaded machines make milliseconds worthless: the ratios count.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator
from pathlib import Path

HERE = Path(__file__).resolve()
SHADINGS = ("SOLID", "MATERIAL")
LIGHT_MOVES = 8
LONGEST = 500.0  # seconds of one Blender


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--zip", type=Path, required=True)
    parser.add_argument("--ui", required=True)
    parser.add_argument("--headless", required=True)
    parser.add_argument("--side", type=int, default=224)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--gpu-backend", default="opengl")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "BLENDER_USER_RESOURCES": folder}
        headless, output = shlex.split(arguments.headless), Path(folder) / "frames.json"
        install = ("--command", "extension", "install-file", "-r", "user_default", "--enable")
        installed = subprocess.run([*headless, *install, str(arguments.zip.resolve())], env=environment,
                                   capture_output=True, text=True, check=False)
        if installed.returncode:
            print(installed.stdout + installed.stderr)
            return 1
        numbers = [str(n) for n in (arguments.side, arguments.frames, arguments.rounds)]
        start = [*shlex.split(arguments.ui), "--gpu-backend", arguments.gpu_backend, "--python", str(HERE)]
        done = subprocess.run([*start, "--", str(output), *numbers], env=environment, capture_output=True, text=True,
                              timeout=LONGEST, check=False)
        if not output.is_file():
            print(done.stdout[-3000:] + done.stderr[-3000:])
            return 1
        tell(json.loads(output.read_text()))
    return 0


def tell(found: dict) -> None:
    """The table."""
    print(f"{found['receivers']} receivers, {found['backend']}, {found['size']}; medians of {found['frames']} frames")
    print("shading   plain ms  preview ms  ratio  (of rounds)")
    for shading in SHADINGS:
        plain, lit = found[shading]
        rounds, ratio = " ".join(f"{b / a:.2f}" for a, b in zip(plain, lit, strict=True)), median(lit) / median(plain)
        print(f"{shading.lower():9} {median(plain):8.1f} {median(lit):11.1f} {ratio:6.2f}  {rounds}")
    light, frame = found["light"], median(found["SOLID"][1])
    print(f"from a Sun's turn to the end of the redraw that shows it: {median(light):.0f} ms ({min(light):.0f} to "
          f"{max(light):.0f}), {median(light) / frame:.1f} frames of the preview")
    for name, milliseconds in found["parts"].items():
        print(f"  {name}: {milliseconds:.2f} ms")


def median(values: list[float]) -> float:
    return sorted(values)[len(values) // 2]


def inside() -> None:
    """In Blender: bake, measure, write, quit."""
    import bpy

    output, (side, frames, rounds) = sys.argv[-4], map(int, sys.argv[-3:])
    steps = measure(Path(output), side, frames, rounds)

    def advance() -> float | None:
        try:
            return next(steps)
        except StopIteration:
            pass
        except Exception:
            import traceback
            traceback.print_exc()
        bpy.ops.wm.quit_blender()
        return None

    bpy.app.timers.register(advance, first_interval=2.0, persistent=True)


def measure(output: Path, side: int, frames: int, rounds: int) -> Generator[float]:
    from importlib import import_module

    import bpy
    import gpu

    live = import_module("bl_ext.user_default.prt.operators.live_preview")
    make_field(side)
    window = bpy.context.window_manager.windows[0]
    area = next(a for a in window.screen.areas if a.type == "VIEW_3D")
    region, space = next(r for r in area.regions if r.type == "WINDOW"), area.spaces.active
    space.overlay.show_overlays = False
    yield 0.5
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.context.scene.prt.preset = "draft"
        overrides = "spacing=0, directions=256, gather_directions=64, error_receivers=0, bounces=0"
        assert bpy.ops.prt.bake("EXEC_DEFAULT", overrides=overrides) == {"FINISHED"}
    yield 2.0

    def toggle() -> None:
        with bpy.context.temp_override(window=window, area=area, region=region):
            bpy.ops.prt.toggle_preview()

    def orbit(count: int) -> float:
        """Milliseconds per frame: Blender's own redraws, to the end of the drawing."""
        spent = []
        for number in range(count):
            view = space.region_3d
            view.view_rotation = (0.82, 0.42, 0.17 + 0.02 * (number % 3), 0.33)
            started = time.perf_counter()
            with bpy.context.temp_override(window=window, area=area, region=region):
                bpy.ops.wm.redraw_timer(type="DRAW", iterations=1)
            spent.append(1e3 * (time.perf_counter() - started))
        return median(spent)

    found: dict = {"receivers": side * side, "backend": gpu.platform.backend_type_get(), "frames": frames,
                   "size": f"{region.width}x{region.height}", "light": []}
    space.region_3d.view_distance = 3.0
    for shading in SHADINGS:
        space.shading.type = shading
        yield 4.0 if shading == "MATERIAL" else 1.0
        for _ in range(2):  # compile and upload, on and off
            toggle()
            yield 1.0
            orbit(2)
        plain, lit = [], []
        for _ in range(rounds):
            plain.append(orbit(frames))
            toggle()
            yield 0.6
            orbit(2)
            lit.append(orbit(frames))
            toggle()
            yield 0.3
            orbit(2)
        found[shading] = plain, lit
    space.shading.type = "SOLID"
    toggle()
    yield 1.0
    found["light"] = yield from light_moves(region, live)
    found["parts"] = parts(live, window, area, region)
    output.write_text(json.dumps(found))


def light_moves(region: object, live: object) -> Generator[float, None, list[float]]:
    """Milliseconds from a Sun's turn to the end of the first redraw with the new light."""
    import bpy

    drawn: list[tuple[float, object]] = []

    def after() -> None:
        drawn.append((time.perf_counter(), live._live.signature))

    handle, result = bpy.types.SpaceView3D.draw_handler_add(after, (), "WINDOW", "POST_PIXEL"), []
    sun = bpy.data.objects["Sun"]
    for number in range(LIGHT_MOVES):
        before = live._live.signature
        drawn.clear()
        sun.rotation_euler[2] += 0.1
        started = time.perf_counter()
        while not (seen := [t for t, light in drawn if light and light != before]):
            yield 0.001
            assert time.perf_counter() - started < 20.0, number
        result.append(1e3 * (seen[0] - started))
        yield 0.3
    bpy.types.SpaceView3D.draw_handler_remove(handle, "WINDOW")
    return result


def parts(live: object, window: object, area: object, region: object) -> dict[str, float]:
    """Milliseconds of what is ours in Python."""
    import bpy

    def timed(work: object, count: int = 20) -> float:
        started = time.perf_counter()
        for _ in range(count):
            work()
        return 1e3 * (time.perf_counter() - started) / count

    with bpy.context.temp_override(window=window, area=area, region=region):
        return {"draw list": timed(live.draw_list), "shows everything": timed(live.shows_everything),
                "occluders": timed(live.occluders), "stale check": timed(live._read_stale, 3),
                "light": timed(live._read_light, 3)}


def make_field(side: int) -> None:
    """A bumpy field of side x side vertices under a Sun and a grey sky."""
    import bpy
    import numpy as np

    bpy.ops.wm.read_homefile(use_empty=True, load_ui=False)
    ticks = np.linspace(-1.0, 1.0, side)
    x, y = np.meshgrid(ticks, ticks, indexing="ij")
    points = np.stack([x, y, 0.06 * np.sin(12 * x) * np.cos(9 * y)], axis=-1).reshape(-1, 3)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).reshape(-1)
    faces = np.stack([corner, corner + side, corner + side + 1, corner + 1], axis=1)
    mesh = bpy.data.meshes.new("Field")
    mesh.from_pydata(points.tolist(), [], faces.tolist())
    mesh.shade_smooth()
    scene = bpy.context.scene
    scene.collection.objects.link(bpy.data.objects.new("Field", mesh))
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.rotation_euler = (0.6, 0.2, 0.0)
    scene.collection.objects.link(sun)
    scene.world = bpy.data.worlds.new("World")
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.3, 0.3, 0.3, 1.0)


if __name__ == "__main__":
    if "bpy" in sys.modules:
        inside()
    else:
        sys.exit(main())
