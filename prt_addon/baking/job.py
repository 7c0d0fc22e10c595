# SPDX-License-Identifier: GPL-3.0-or-later
"""Job folders: a bake's input, its finished stages and its result, so that an interrupted bake resumes.

The folder's name holds a digest of the scene and the settings: the same job finds its stages again, any other starts
afresh. Where another living process bakes the same job, the folder has a number behind its digest.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import asdict
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import StorageError
from ..lighting.reference_light import ReferenceLight
from ..scene.scene_mesh import SceneMesh, SceneObject, with_surfaces
from ..scene.surface_material import SurfaceMaterial
from ..scene.texel_surface import NUMBERS, TexelSurface
from ..storage.container import REBAKE, BakedTransfer, check_header, flatten_cloud, read_cloud
from ..storage.digests import digest_arrays, digest_json
from ..storage.files import intact, load_arrays, save_arrays
from ..storage.lamp_surfaces import read_lamp_surfaces
from ..storage.subsurface_links import flatten_links, read_links
from ..storage.texels import ENTRY as ATLAS_ENTRY
from ..tracing.tracer import Tracer
from ..transport.live_operator import LiveOperator
from .claims import Claim
from .recipe import BakeResult, Progress, bake
from .settings import BakeSettings

# Raised whenever the same input would give other numbers, so that old stages are not mixed with new code.
JOB_SCHEMA = 5
SCENE_FILE, RESULT_FILE = "scene.npz", "result.npz"
_SCENE_ARRAYS = ("points", "normals", "triangles", "albedo", "loose", "material", "tangents", "source")
_CONTAINER_ARRAYS = ("cluster", "weights", "bases", "albedo", "positions", "normals", "triangles")
_CONTAINER_EXTRA = ("tangents", "source", "error")  # None where there are none
_LAMP_ARRAYS = ("material", "kernels")  # of lamp_surfaces
_LIVE_ARRAYS = ("counts", "indices", "values", "surfaces")  # of live


def write_job(root: Path, scene: SceneMesh, settings: BakeSettings, light: ReferenceLight | None = None,
              digests: dict[str, str] | None = None, regions: NDArray[np.float64] | None = None) -> Path:
    """`claim_job` for whoever knows that nobody else works below `root`: the folder, unclaimed."""
    claim = claim_job(root, scene, settings, light, digests, regions)
    claim.release()
    return claim.folder


def claim_job(root: Path, scene: SceneMesh, settings: BakeSettings, light: ReferenceLight | None = None,
              digests: dict[str, str] | None = None, regions: NDArray[np.float64] | None = None) -> Claim:
    """Write the input of a bake into its folder below `root`, claimed for this process; finished stages there stay.

    digests: of the geometry by object name, kept in the headers. regions: of local lights, see `bake`. Raises
    StorageError where `root` can't be written.
    """
    arrays = {name: getattr(scene, name) for name in _SCENE_ARRAYS}
    arrays["regions"] = np.empty((0, 4, 4)) if regions is None else regions
    for index, surface in enumerate(scene.surfaces):
        arrays |= {} if surface is None else _surface_arrays(f"surface_{index}_", surface)
    header = {
        "schema": JOB_SCHEMA,
        "objects": [_object_header(o) for o in scene.objects],
        "materials": [asdict(material) for material in scene.materials],
        "warnings": list(scene.warnings),
        "surfaces": [None if surface is None else surface.numbers() for surface in scene.surfaces],
        "settings": settings.as_dict(),
        "geometry_digests": digests or {},
        "light": None,
    }
    if light is not None:
        arrays |= {f"light_{name}": value for name, value in light.arrays().items()}
        header["light"] = light.header()
    name = digest_json([digest_arrays(*(np.asarray(arrays[key]) for key in sorted(arrays))), header])
    claim = _claim(root, f"bake-{name[:24]}")
    try:
        if intact(claim.folder / SCENE_FILE) is None:
            save_arrays(claim.folder / SCENE_FILE, arrays, header)
    except BaseException:
        claim.release()
        raise
    return claim


def _claim(root: Path, name: str) -> Claim:
    """The first folder of this name, with a number from the second on, in which nobody works."""
    for folder in (root / (name if number == 1 else f"{name}-{number}") for number in count(1)):
        try:
            claim = Claim.make(folder)
        except OSError as error:
            raise StorageError(str(folder), f"the job folder can't be made ({error.strerror})",
                               "Free some space, or choose a folder that can be written") from error
        if claim is not None:
            return claim
    raise AssertionError("numbers do not end")


def _object_header(scene_object: SceneObject) -> dict[str, Any]:
    entry = asdict(scene_object)
    entry["points"] = [scene_object.points.start, scene_object.points.stop]
    entry["triangles"] = [scene_object.triangles.start, scene_object.triangles.stop]
    entry["matrix"] = np.asarray(scene_object.matrix, np.float64).ravel().tolist()
    return entry


def read_job(folder: Path) -> tuple[SceneMesh, BakeSettings, ReferenceLight | None, dict[str, str],
                                    NDArray[np.float64]]:
    """The input written by `write_job`. Raises StorageError."""
    arrays, header = load_arrays(folder / SCENE_FILE)
    objects = tuple(
        SceneObject(**{**entry, "points": slice(*entry["points"]), "triangles": slice(*entry["triangles"]),
                       "matrix": np.reshape(entry["matrix"], (4, 4))})
        for entry in header["objects"])
    surfaces = tuple(None if numbers is None else _surface(f"surface_{index}_", arrays, numbers)
                     for index, numbers in enumerate(header["surfaces"]))
    scene = with_surfaces(SceneMesh(**{name: arrays[name] for name in _SCENE_ARRAYS}, objects=objects,
                                    materials=tuple(_material(entry) for entry in header["materials"]),
                                    warnings=tuple(header["warnings"])), surfaces)
    light = None
    if header["light"] is not None:
        stored = {name[len("light_"):]: value for name, value in arrays.items() if name.startswith("light_")}
        light = ReferenceLight.from_arrays(stored, header["light"])
    return scene, BakeSettings(**header["settings"]), light, header["geometry_digests"], arrays["regions"]


def _surface_arrays(prefix: str, surface: TexelSurface) -> dict[str, NDArray]:
    return {prefix + name: values for name, values in surface.arrays().items()}


def _surface(prefix: str, arrays: dict[str, NDArray], numbers: dict[str, Any]) -> TexelSurface:
    return TexelSurface(**{name[len(prefix):]: values for name, values in arrays.items() if name.startswith(prefix)},
                        **numbers)


def _material(entry: dict[str, Any]) -> SurfaceMaterial:
    """The material of a header's entry: JSON turns its colours into lists."""
    return SurfaceMaterial(**{name: tuple(value) if isinstance(value, list) else value
                              for name, value in entry.items()})


def run_job(folder: Path, make_tracer: Callable[..., Tracer] = Tracer) -> Generator[Progress]:
    """Bake a job, resuming after its finished stages, and leave the result in its folder. make_tracer: see `bake`."""
    if intact(folder / RESULT_FILE) is not None:
        return
    scene, settings, light, digests, regions = read_job(folder)
    result = yield from bake(scene, settings, folder, light, digests, regions, make_tracer)
    arrays = {f"{index}_{name}": getattr(container, name) for index, container in enumerate(result.objects.values())
              for name in _CONTAINER_ARRAYS + _CONTAINER_EXTRA if getattr(container, name) is not None}
    arrays |= {f"{index}_cloud": flatten_cloud(container.cloud) for index, container in enumerate(
        result.objects.values()) if container.cloud is not None}
    arrays |= {f"{index}_{name}": getattr(container, name) for index, container in enumerate(result.objects.values())
               for name in _LAMP_ARRAYS if container.lamp_surfaces is not None}
    arrays |= {f"{index}_live_{name}": value for index, container in enumerate(result.objects.values())
               if container.live is not None for name, value in container.live.arrays().items()}
    for index, container in enumerate(result.objects.values()):
        arrays |= {} if container.texels is None else _surface_arrays(f"{index}_texels_", container.texels)
    arrays |= {f"{index}_links": flatten_links(container.links) for index, container in enumerate(
        result.objects.values()) if container.links is not None}
    headers = [container.header for container in result.objects.values()]
    save_arrays(folder / RESULT_FILE, arrays, {"names": list(result.objects), "headers": headers,
                                               "report": result.report})


def read_result(folder: Path) -> BakeResult:
    """The complete, checked result of a job. Raises StorageError where there is none."""
    arrays, stored = load_arrays(folder / RESULT_FILE)
    objects = {}
    for index, (name, header) in enumerate(zip(stored["names"], stored["headers"], strict=True)):
        parts = [arrays[f"{index}_{part}"] for part in _CONTAINER_ARRAYS]
        extra = {part: arrays.get(f"{index}_{part}") for part in _CONTAINER_EXTRA}
        cloud = read_cloud(check_header(header, name), arrays.get(f"{index}_cloud"), name)
        lamps = read_lamp_surfaces(header, *(arrays.get(f"{index}_{part}") for part in _LAMP_ARRAYS), len(parts[0]),
                                   name, REBAKE)
        live = LiveOperator.of_arrays({part: arrays[f"{index}_live_{part}"] for part in _LIVE_ARRAYS}) \
            if f"{index}_live_counts" in arrays else None
        atlas = header.get(ATLAS_ENTRY)
        texels = None if atlas is None else _surface(f"{index}_texels_", arrays, {k: atlas[k] for k in NUMBERS})
        links = read_links(header, arrays.get(f"{index}_links"), len(parts[0]), name, REBAKE)
        container = BakedTransfer(header, *parts, **extra, cloud=cloud, lamp_surfaces=lamps, live=live,
                                  texels=texels, links=links)
        if not (np.isfinite(container.bases).all() and np.isfinite(container.weights).all()):
            raise StorageError(name, "the bake's result holds values that are not finite", "Please report this scene")
        objects[name] = container
    return BakeResult(objects, stored["report"])


def discard(claim: Claim) -> None:
    """Remove a job's folder, once its result has been applied or it is not wanted any more."""
    claim.discard()


def job_summary(folder: Path) -> dict[str, Any]:
    """{"finished": names of finished stages, "complete": whether the result is there} of a job folder."""
    finished = sorted(p.stem for p in folder.glob("*.npz") if p.name not in (SCENE_FILE, RESULT_FILE))
    return {"finished": finished, "complete": (folder / RESULT_FILE).exists()}
