# SPDX-License-Identifier: GPL-3.0-or-later
"""What each verb of the command line does. Each takes the parsed arguments, yields the lines of its result for stdout,
raises PRTError, and leaves every existing file alone until its own output is complete.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np

from ..prt_addon.baking.process import raise_error
from ..prt_addon.baking.settings import BakeSettings, make_settings
from ..prt_addon.blender.image_albedo import surface_textures
from ..prt_addon.blender.lights import environment_picture
from ..prt_addon.blender.save import save_blend
from ..prt_addon.errors import BadArguments, StorageError
from ..prt_addon.relighting.moved_light import moved_normals, moved_points
from ..prt_addon.reporting.headline import headline
from ..prt_addon.reporting.html_report import render
from ..prt_addon.reporting.report_file import read_report, write_report
from ..prt_addon.storage.container import BakedTransfer
from ..prt_addon.storage.files import save_arrays, save_json, write_atomically
from .bake_session import BakeSession, analyze_scene
from .job_mixin import progress_text
from .relit import Lit, read_all, relit

PROGRESS_SECONDS = 1.0  # between two lines of progress of one stage


def analyze(arguments: argparse.Namespace) -> Iterator[str]:
    """JSON: what the scene needs, what is left out and why, expected seconds and bytes."""
    settings = _settings(arguments)
    _open(arguments.input)
    yield json.dumps(analyze_scene(bpy.context.evaluated_depsgraph_get(), settings, arguments.objects), indent=1)


def bake(arguments: argparse.Namespace) -> Iterator[str]:
    """The paths written: the baked file and, where asked for, the report."""
    settings = _settings(arguments)
    _check_output(arguments.output, (".blend",), arguments.input)
    if arguments.report is not None:
        _check_output(arguments.report, (".json",), arguments.input)
    _open(arguments.input)
    session = BakeSession.start(bpy.context.evaluated_depsgraph_get(), settings, arguments.objects)
    try:
        _follow(session)
        result = session.store()
        save_blend(arguments.output)
        if arguments.report is not None:
            write_report(arguments.report, result.report)
        session.discard()  # only now: until the file is saved, the finished stages are all there is
    finally:
        session.close()
    _tell(headline(result.report))
    yield str(arguments.output)
    if arguments.report is not None:
        yield str(arguments.report)


def relight(arguments: argparse.Namespace) -> Iterator[str]:
    """The path written: arrays radiance, position, normal, albedo (points, 3) float32 and object (points,) text.

    Where radiance depends on the view, it is that towards the normal.
    """
    _check_output(arguments.output, (".npz",), arguments.input)
    scene = _open(arguments.input)
    baked = read_all(scene, str(arguments.input))
    lit = _lit(scene, baked, arguments, arguments.use_scene_lights)
    radiances = [lit.radiance(name, b) for name, b in baked.items()]
    save_arrays(arguments.output, {
        "radiance": np.concatenate(radiances).astype(np.float32),
        "position": np.concatenate([moved_points(b.positions, lit.moved[n]) for n, b in baked.items()]).astype("f4"),
        "normal": np.concatenate([moved_normals(b.normals, lit.moved[n]) for n, b in baked.items()]).astype("f4"),
        "albedo": np.concatenate([b.albedo for b in baked.values()]),
        "object": np.concatenate([np.full(len(b.cluster), name) for name, b in baked.items()]),
    })
    yield str(arguments.output)


def preview(arguments: argparse.Namespace) -> Iterator[str]:
    """The path written: the active camera's view, through the viewport's shaders."""
    from ..gpu_shaders import offscreen  # a machine without a graphics driver has all other verbs
    from ..gpu_shaders.render_data import DrawItem

    _check_output(arguments.output, (".png",), arguments.input)
    scene = _open(arguments.input)
    baked = read_all(scene, str(arguments.input))
    lit = _lit(scene, baked, arguments, use_scene_lights=True)
    percentage = scene.render.resolution_percentage / 100.0
    width, height = arguments.size or (max(1, round(scene.render.resolution_x * percentage)),
                                       max(1, round(scene.render.resolution_y * percentage)))
    depsgraph = bpy.context.evaluated_depsgraph_get()
    items = [DrawItem(name, b, lit.moved[name], lit.light[name], direct=lit.direct[name],
                      textures=surface_textures(scene.objects[name], b, depsgraph)) for name, b in baked.items()]
    background = None
    if not scene.render.film_transparent:
        sky, rotation = environment_picture(scene, bpy.context.evaluated_depsgraph_get(), arguments.environment,
                                            arguments.rotate)
        sample = offscreen.environment_sampler(sky, rotation)
        background = offscreen.camera_background(scene, sample, width, height)
    picture = offscreen.draw_items(scene, items, width, height, background)
    offscreen.write_png(arguments.output, picture, scene)
    yield str(arguments.output)


def report(arguments: argparse.Namespace) -> Iterator[str]:
    """The path written: the page."""
    if not arguments.input.is_file():
        raise BadArguments(str(arguments.input), "there is no such file", "Give a report that `prt bake` wrote")
    _check_output(arguments.output, (".html", ".htm"), arguments.input)
    told = read_report(arguments.input)
    page = render(told).encode()
    write_atomically(arguments.output, lambda stream: stream.write(page) and None)
    _tell(headline(told))
    yield str(arguments.output)


def export(arguments: argparse.Namespace) -> Iterator[str]:
    """The paths written: per object an .npz of everything stored, and baked.json that describes them."""
    folder = arguments.output
    if folder.exists() and not folder.is_dir():
        raise BadArguments(str(folder), "it is a file", "Give a folder")
    _check_folder(folder.absolute().parent)
    scene = _open(arguments.input)
    baked = read_all(scene, str(arguments.input))
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise StorageError(str(folder), f"can't be made ({error.strerror})", "Choose another folder") from error
    written = {array: text for array, text in ARRAYS.items()
               if any(getattr(transfer, array) is not None for transfer in baked.values())}
    index = {"format": "prt", "schema": 1, "arrays": written, "objects": []}
    for number, (name, transfer) in enumerate(baked.items()):
        path = folder / f"{number:04d}_{_file_name(name)}.npz"
        save_arrays(path, {array: getattr(transfer, array) for array in ARRAYS
                           if getattr(transfer, array) is not None})
        index["objects"].append({"name": name, "file": path.name, "header": transfer.header})
        yield str(path)
    save_json(folder / "baked.json", index)
    yield str(folder / "baked.json")


# What export writes of each object, described for whoever reads it without this program.
ARRAYS = {
    "cluster": "(points,) int32: the cluster of each point",
    "weights": "(points, vectors) float32",
    "bases": "(clusters, vectors+1, rows, columns, channels) float32; vector 0 is the cluster's mean; "
             "M_p = bases[c,0] + sum_k weights[p,k] bases[c,k+1]; exit radiance = albedo * M_p . light; "
             "with view-dependent rows: albedo * (row 0) + sum_i y_i(view in the point's frame) * (row i), the "
             "functions i being the header's rows.functions",
    "albedo": "(points, 3) float32, linear Rec.709",
    "positions": "(points, 3) float32, world space when baked, metres, Z up",
    "normals": "(points, 3) float32, world space when baked",
    "triangles": "(triangles, 3) int32 into points",
    "tangents": "(points, 3) float32, world space when baked: x of the point's frame, whose y is normal x tangent and "
                "whose z is the normal; only where rows depend on the view",
    "material": "(points,) int32 into kernels; only with view-dependent rows and a light cloud",
    "kernels": "(materials, functions, n^2, 1 or 3) float32: rows 1, 2, ... of a lamp's direct light are kernel . "
               "y(direction to the lamp in the point's frame) times its E / pi; share and dimming of the diffuse row "
               "are in the header's lamp_surfaces",
}


def _tell(text: str) -> None:
    """A line for a person; stdout carries the result only."""
    print(f"prt: {text}", file=sys.stderr, flush=True)


def _settings(arguments: argparse.Namespace) -> BakeSettings:
    chosen = {} if arguments.lighting is None else {"lighting": arguments.lighting}
    return make_settings(arguments.preset, chosen | dict(arguments.overrides))


def _open(path: Path) -> bpy.types.Scene:
    """Open a .blend file without its window layout. Its own scripts do not run. Raises BadArguments, StorageError."""
    if not path.is_file():
        raise BadArguments(str(path), "there is no such file", "Give a saved .blend file as --input")
    try:
        bpy.ops.wm.open_mainfile(filepath=str(path.absolute()), load_ui=False, use_scripts=False)
    except RuntimeError as error:
        cause = " ".join(str(error).removeprefix("Error:").split()).rstrip(".")
        raise StorageError(str(path), f"Blender can't open it ({cause})", "Give an intact .blend file") from error
    if bpy.context.mode != "OBJECT":  # a file saved in edit mode opens in it, and then its mesh can't be read
        bpy.ops.object.mode_set(mode="OBJECT")
    return bpy.context.scene


def _check_output(path: Path, suffixes: tuple[str, ...], source: Path) -> None:
    """Find out before hours of work, not after, that an output can't be written."""
    if path.suffix.lower() not in suffixes:
        raise BadArguments(str(path), f"the name does not end in {' or '.join(suffixes)}", "Give a fitting name")
    if path.is_dir():
        raise BadArguments(str(path), "it is a folder", "Give the name of a file")
    if path.exists() and source.exists() and path.samefile(source):
        raise BadArguments(str(path), "output and input are the same file", "Give another --output; the input is kept")
    _check_folder(path.absolute().parent)
    if path.exists() and not _writable(path):
        raise StorageError(str(path), "it is read-only", "Choose another name, or allow writing to it")


def _check_folder(folder: Path) -> None:
    if not folder.is_dir():
        raise StorageError(str(folder), "there is no such folder", "Make it, or choose another one")
    if not _writable(folder):
        raise StorageError(str(folder), "the folder is read-only", "Choose a folder that can be written")


def _writable(path: Path) -> bool:
    """Whether the path's owner meant it to be written: the administrator's os.access says yes to everything."""
    return os.access(path, os.W_OK) and bool(path.stat().st_mode & 0o222)


def _follow(session: BakeSession) -> None:
    """Wait for the child, with its progress on stderr."""
    stage, last = "", -math.inf
    for message in session.process.wait():
        if message["type"] == "error":
            raise_error(message)
        if message["type"] == "progress" and (message["stage"] != stage or time.monotonic() - last > PROGRESS_SECONDS):
            stage, last = message["stage"], time.monotonic()
            print(f"prt: {progress_text(message)}", file=sys.stderr, flush=True)


def _lit(scene: bpy.types.Scene, baked: dict[str, BakedTransfer], arguments: argparse.Namespace,
         use_scene_lights: bool) -> Lit:
    """The light that the arguments ask for, with its warnings on stderr."""
    if not math.isfinite(arguments.rotate):
        raise BadArguments("--rotate", f"{arguments.rotate} is no angle", "Give degrees")
    lit = relit(scene, baked, arguments.environment, arguments.rotate, use_scene_lights, arguments.window)
    for warning in lit.warnings:
        print(f"prt: warning: {warning}", file=sys.stderr, flush=True)
    return lit


def _file_name(name: str) -> str:
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in name)[:80]
