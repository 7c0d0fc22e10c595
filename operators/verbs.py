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

from ..prt_addon.baking.process import raise_error
from ..prt_addon.baking.settings import BakeSettings, make_settings
from ..prt_addon.blender.pictures import write_picture
from ..prt_addon.blender.save import save_blend
from ..prt_addon.errors import BadArguments, StorageError
from ..prt_addon.reporting.headline import headline
from ..prt_addon.reporting.html_report import render
from ..prt_addon.reporting.report_file import read_report, write_report
from ..prt_addon.storage.container import BakedTransfer
from ..prt_addon.storage.files import save_arrays, save_json, write_atomically
from .arguments import size_in
from .bake_session import BakeSession, analyze_scene
from .compare_session import CompareSession
from .draw_camera import draw_to_file
from .export import check_folder, export_bakes
from .job_mixin import progress_text
from .relit import Lit, radiance_arrays, read_all, relit

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
    if arguments.lamps_by_directions and not arguments.use_scene_lights:
        raise BadArguments("--lamps-by-directions", "the scene's lamps are not asked for", "Add --use-scene-lights")
    scene = _open(arguments.input)
    baked = read_all(scene, str(arguments.input))
    lit = _lit(scene, baked, arguments, arguments.use_scene_lights)
    save_arrays(arguments.output, radiance_arrays(baked, lit))
    yield str(arguments.output)


def preview(arguments: argparse.Namespace) -> Iterator[str]:
    """The path written: the active camera's view, through the viewport's shaders."""
    _check_output(arguments.output, (".png",), arguments.input)
    _check_angle(arguments.rotate)
    scene = _open(arguments.input)
    draw_to_file(scene, arguments.output, arguments.size or size_in(scene), arguments.environment, arguments.rotate,
                 arguments.window, _warn, arguments.lamps_by_directions)
    yield str(arguments.output)


def compare(arguments: argparse.Namespace) -> Iterator[str]:
    """The paths written: preview, Cycles and their difference as a picture and, where asked for, the numbers."""
    _check_output(arguments.output, (".png",), arguments.input)
    if arguments.report is not None:
        _check_output(arguments.report, (".json",), arguments.input)
    scene = _open(arguments.input)
    session = CompareSession.start(scene, arguments.size or size_in(scene), arguments.samples)
    try:
        _follow(session)
    finally:
        session.process.cancel()
    compared = session.finish()
    write_picture(arguments.output, compared.picture)
    if arguments.report is not None:
        save_json(arguments.report, compared.result)
    for line in compared.lines:
        _tell(line)
    yield str(arguments.output)
    if arguments.report is not None:
        yield str(arguments.report)


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
    check_folder(folder)
    _check_folder(folder.absolute().parent)
    scene = _open(arguments.input)
    baked = read_all(scene, str(arguments.input))
    for path in export_bakes(baked, folder, relit(scene, baked)):
        yield str(path)


def _tell(text: str) -> None:
    """A line for a person; stdout carries the result only."""
    print(f"prt: {text}", file=sys.stderr, flush=True)


def _warn(text: str) -> None:
    _tell(f"warning: {text}")


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


def _follow(session: BakeSession | CompareSession) -> None:
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
    _check_angle(arguments.rotate)
    lit = relit(scene, baked, arguments.environment, arguments.rotate, use_scene_lights, arguments.window,
                by_directions=arguments.lamps_by_directions)
    for warning in lit.warnings:
        _warn(warning)
    return lit


def _check_angle(degrees: float) -> None:
    if not math.isfinite(degrees):
        raise BadArguments("--rotate", f"{degrees} is no angle", "Give degrees")
