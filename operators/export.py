# SPDX-License-Identifier: GPL-3.0-or-later
"""prt.export: baked data for other programs, and the function that the command shares with it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import bpy
from numpy.typing import NDArray

from ..prt_addon.errors import BadArguments, PRTError, StorageError
from ..prt_addon.storage.container import BakedTransfer
from ..prt_addon.storage.files import save_arrays, save_json
from .arguments import path_of
from .export_atlas import FILES, export_atlases, file_name
from .polls import refuse, why_not_read
from .relit import Lit, read_all, relit

# What is written of each object, described for whoever reads it without this program.
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
    "texel_column": "(points,) int32: of each texel in its atlas; only of bakes at texels, whose header has an atlas",
    "texel_row": "(points,) int32, row 0 the lowest",
}


def check_folder(folder: Path) -> None:
    """Raise BadArguments where a folder to export to is a file."""
    if folder.exists() and not folder.is_dir():
        raise BadArguments(str(folder), "it is a file", "Give a folder")


def export_bakes(baked: dict[str, BakedTransfer], folder: Path, lit: Lit) -> Iterator[Path]:
    """Write per object an .npz of everything stored, and baked.json that describes them; the paths as they are done.

    lit: the light of now, for the lightmaps of bakes at texels (`export_atlas`). Raises StorageError where the folder
    can't be made or written.
    """
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise StorageError(str(folder), f"can't be made ({error.strerror})", "Choose another folder") from error
    arrays = {name: _arrays_of(transfer) for name, transfer in baked.items()}
    written = {array: text for array, text in ARRAYS.items() if any(array in found for found in arrays.values())}
    index = {"format": "prt", "schema": 1, "arrays": written, "objects": []}
    if any(transfer.texels is not None for transfer in baked.values()):
        index["atlases"] = {f"NUMBER_NAME_{file}": text for file, text in FILES.items()}
    for number, (name, transfer) in enumerate(baked.items()):
        path = folder / f"{number:04d}_{file_name(name)}.npz"
        save_arrays(path, arrays[name])
        index["objects"].append({"name": name, "file": path.name, "header": transfer.header})
        yield path
    yield from export_atlases(baked, folder, lit)
    save_json(folder / "baked.json", index)
    yield folder / "baked.json"


def _arrays_of(baked: BakedTransfer) -> dict[str, NDArray]:
    """What is written of a bake."""
    texels = {} if baked.texels is None else {"texel_column": baked.texels.column, "texel_row": baked.texels.row}
    own = {array: getattr(baked, array, None) for array in ARRAYS}
    return {array: values for array, values in own.items() if values is not None} | texels


class PRT_OT_export(bpy.types.Operator):
    """Write the bakes of all objects into a folder, as arrays (.npz) and a description (baked.json) that say all a game
    engine needs to relight them; of objects baked at texels also their light and weights as pictures (.exr) and
    their surface with UVs (.obj). Costs as much disk as the bakes take in this file"""

    bl_idname = "prt.export"
    bl_label = "Export Bakes"

    directory: bpy.props.StringProperty(
        name="Folder", subtype="DIR_PATH", options={"SKIP_SAVE"},
        description="Where the files go; it is made where it is missing. Files of an earlier export are replaced",
    )
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return refuse(cls, why_not_read(context))

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            if not self.directory:
                raise BadArguments("Export", "no folder is given", "Give directory=")
            folder = path_of(self.directory)
            check_folder(folder)
            scene = context.scene
            baked = read_all(scene, scene.name)
            lit = relit(scene, baked, window=scene.prt.window, by_directions=scene.prt.lamps_by_directions)
            for _ in export_bakes(baked, folder, lit):
                pass
        except PRTError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Exported {len(baked)} object{'' if len(baked) == 1 else 's'} to {folder}")
        return {"FINISHED"}
