# SPDX-License-Identifier: GPL-3.0-or-later
"""One comparison of the preview with Cycles, around the child process: for the operator and the command alike.

The preview is drawn and the file copied at the start, so that both show the same moment, whatever the artist changes
while Cycles works.
"""

from __future__ import annotations

import contextlib
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import bpy
import numpy as np
from numpy.typing import NDArray

from ..prt_addon.blender.comparison_sheet import comparison_sheet
from ..prt_addon.blender.ground_truth import RenderProcess, parts_of, read_render, start_render
from ..prt_addon.blender.pictures import Picture, read_picture, show_image, store_image, write_picture
from ..prt_addon.blender.stored_report import stored_report
from ..prt_addon.errors import BadArguments, BadScene, StorageError
from ..prt_addon.reporting.comparison import compare, comparison_lines, false_colours, inner_pixels
from ..prt_addon.reporting.svg_plots import percent
from ..prt_addon.storage.files import save_json
from .place import Place
from .properties import assign, session
from .relit import draw_lit, read_all, relit
from .side_job import SideJob

DRAWN_SAMPLES = 4  # of the preview, per pixel and axis: edges within objects as smooth as those of the render
MANY_PIXELS = 10 ** 6  # from which on edges are fine enough, and such a picture takes too much memory
BEHIND = (0.05, 0.05, 0.05)  # what both pictures stand on, scene-linear: the sky does not count
MOST_SAMPLES = 2 ** 16
IMAGE = "PRT Comparison"


@dataclass(frozen=True)
class Compared:
    """What came out: `result` as a report (see `comparison.compare`, with cycles, preview_seconds, size, remarks), its
    lines for a person, and the picture."""

    result: dict[str, Any]
    picture: Picture

    @property
    def lines(self) -> list[str]:
        """The numbers in words, then what is not compared like with like."""
        return comparison_lines(self.result) + self.result["remarks"]


@dataclass(frozen=True)
class CompareRequest:
    """One press on Compare, until its turn comes. size: (width, height); picture, report: files to write, or None."""

    place: Place
    size: tuple[int, int]
    samples: int
    picture: Path | None = None
    report: Path | None = None
    title: ClassVar[str] = "Comparison with Cycles"

    def start(self) -> CompareSession:
        """Draw the preview and let Cycles begin. Raises PRTError."""
        scene = self.place.find()
        layer = scene.view_layers.get(self.place.view_layer) or scene.view_layers[0]
        with bpy.context.temp_override(scene=scene, view_layer=layer):
            job = CompareSession.start(scene, self.size, self.samples)
        job.picture, job.report = self.picture, self.report
        return job

    def object_in_use(self) -> str | None:
        """An object of the scene that is in edit mode: its bake can't be read."""
        try:
            return next((o.name for o in self.place.find().objects if o.mode == "EDIT"), None)
        except BadScene:
            return None  # `start` says it


@dataclass
class CompareSession(SideJob):
    """A comparison under way: poll `process` until it is finished, then `finish` or `conclude` it. drawn: (h, w, 4),
    scene-linear; remarks: what is not compared like with like; picture, report: files to write, or None."""

    process: RenderProcess
    scene_name: str
    names: list[str]
    drawn: NDArray[np.float32]
    samples: int
    preview_seconds: float
    remarks: list[str]
    picture: Path | None = None
    report: Path | None = None
    notes: tuple[str, ...] = ()  # nothing of what the artist did meanwhile counts

    @staticmethod
    def start(scene: bpy.types.Scene, size: tuple[int, int], samples: int) -> CompareSession:
        """Draw the preview, size (width, height), and let Cycles begin. Raises PRTError."""
        if not 2 <= samples <= MOST_SAMPLES:
            raise BadArguments("samples", f"{samples} can't be halved or is too much", f"Give 2 to {MOST_SAMPLES}")
        parts, samples = parts_of(samples)
        baked = read_all(scene, scene.name)
        lit = relit(scene, baked, window=_window(scene), by_directions=_setting(scene, "lamps_by_directions"))
        draw_lit(scene, baked, lit, 8, 8)  # compiles the shaders, which is no part of a picture's time
        started = time.perf_counter()
        draw_lit(scene, baked, lit, *size)
        seconds = time.perf_counter() - started
        drawn = draw_lit(scene, baked, lit, *size, samples=DRAWN_SAMPLES if size[0] * size[1] <= MANY_PIXELS else 2)
        names = list(baked)
        remarks = [*_remarks(scene, {name: b.header for name, b in baked.items()}), *lit.warnings]
        process = start_render(scene, bpy.context.view_layer, names, size, parts, samples)
        return CompareSession(process, scene.name, names, drawn, samples, seconds, list(dict.fromkeys(remarks)))

    def conclude(self) -> str:
        """`finish`, show the picture and write the files asked for; what to tell the user. Raises PRTError."""
        compared = self.finish()
        shown = show_image(store_image(IMAGE, compared.picture))
        if self.picture is not None:
            write_picture(self.picture, compared.picture)
        if self.report is not None:
            save_json(self.report, compared.result)
        where = [] if shown else [f"The picture is the image \"{IMAGE}\": open an Image Editor to see it"]
        assign(session(), comparison="\n".join([*compared.lines, *where]))
        return f"Compared with Cycles: {compared.lines[0][0].lower()}{compared.lines[0][1:]}"

    def finish(self) -> Compared:
        """Read what Cycles left, and compare. Call it after the "done" message. Raises StorageError."""
        try:
            truth = read_render(self.process, self.samples)
        finally:
            self.process.discard()
        inner = inner_pixels(truth.objects, truth.depth)
        rendered = 0.5 * (truth.halves[0] + truth.halves[1])
        height, width, _ = rendered.shape
        result = compare(self.drawn[..., :3], truth.halves, truth.objects, inner, self.names)
        result |= {"size": [width, height], "cycles": {"samples": truth.samples, "seconds": truth.seconds},
                   "preview_seconds": self.preview_seconds, "remarks": self.remarks}
        difference, limit = false_colours(self.drawn[..., :3], rendered, inner)
        scene = bpy.data.scenes.get(self.scene_name, bpy.context.scene)
        pictures = (displayed(scene, self.drawn[..., :3], self.drawn[..., 3:]),
                    displayed(scene, rendered, truth.alpha))
        rms = result["relative_rms"]
        captions = (f"PRT, {self.preview_seconds:.2f} s",
                    f"Cycles, {truth.samples} samples, {truth.seconds:.1f} s",
                    "Too few pixels to compare" if rms is None else f"PRT minus Cycles: {percent(rms)} RMS")
        return Compared(result, comparison_sheet(*pictures, difference, limit, captions))


def displayed(scene: bpy.types.Scene, colours: NDArray[np.floating], alpha: NDArray[np.floating]) -> Picture:
    """A scene-linear picture (h, w, 3), premultiplied by alpha (h, w, 1), as the scene's view transform shows it."""
    from ..gpu_shaders import offscreen

    picture = np.ones((*colours.shape[:2], 4), np.float32)
    picture[..., :3] = colours + (1.0 - np.clip(alpha, 0.0, 1.0)) * np.float32(BEHIND)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        offscreen.write_png(path, picture, scene)
        return read_picture(path)


def _window(scene: bpy.types.Scene) -> bool:
    """Whether the preview of this scene takes ringing out."""
    return _setting(scene, "window")


def _setting(scene: bpy.types.Scene, name: str) -> bool:
    """A switch of the preview of this scene; a command has no panel to set it."""
    return bool(getattr(getattr(scene, "prt", None), name, False))


def _remarks(scene: bpy.types.Scene, headers: dict[str, dict]) -> list[str]:
    """What Cycles shows and these bakes, by design, do not."""
    found = []
    for name, header in headers.items():
        if header.get("settings", {}).get("bounces") == 0:
            found.append(f"{name}: baked without bounced light")
    with contextlib.suppress(StorageError):  # the report is not what is compared
        report = stored_report(scene) or {"left_out": (), "stages": ()}
        found += [f"Left out of the bake: {item['what']}, because {item['why']}" for item in report["left_out"]
                  if "material" in item["what"]]  # the rest costs no light
        if any(stage["name"] == "subsurface" for stage in report["stages"]):
            found.append("Light through bodies is diffusion here and a random walk in Cycles: thin parts differ")
    if _window(scene):
        found.append("Soften Ringing is on: the preview's light is softer than the scene's")
    lost = [image.name for image in bpy.data.images if image.is_dirty and image.packed_file is None
            and image.users and image.type == "IMAGE"]
    found += [f"{name}: its unsaved changes are not in the render" for name in lost]
    return found
