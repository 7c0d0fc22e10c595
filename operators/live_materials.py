# SPDX-License-Identifier: GPL-3.0-or-later
"""Bounced light that follows edited materials in the preview: who reads them, solves, and says what is drawn.

Bakes that kept their form factors (`live_editing`) share them by sets: the objects of one bake. A set is answered when
its materials changed, and while it has edits also when the light did.
"""

from __future__ import annotations

import time
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import bpy
import numpy as np
from numpy.typing import NDArray

from ..gpu_shaders.radiosity import measured_solver
from ..gpu_shaders.render_data import LampScattering
from ..prt_addon.blender.live_materials import EditedSurfaces, edited_surfaces, read_live, slots_of_receivers
from ..prt_addon.blender.read_scene import read_objects
from ..prt_addon.blender.stored import baked_mesh
from ..prt_addon.errors import PRTError
from ..prt_addon.relighting.exit_radiance import baked_constants, exit_radiance
from ..prt_addon.relighting.glowing_surfaces import glow_of
from ..prt_addon.relighting.material_edits import MaterialEdits
from ..prt_addon.relighting.moved_light import points_in
from ..prt_addon.reporting.wording import plural
from ..prt_addon.scene.scene_mesh import SceneMesh
from ..prt_addon.storage.container import LIVE_ENTRY, BakedTransfer
from ..prt_addon.tracing.tracer import Tracer
from ..prt_addon.transport.radiosity import BICGSTAB, GAUSS_SEIDEL, JACOBI

Single = NDArray[np.float32]
# Where a black surface glows, its glow is drawn as light on an albedo of this size.
LEAST_ALBEDO = np.float32(1e-4)
TITLES = {JACOBI: "Jacobi", GAUSS_SEIDEL: "Gauss-Seidel", BICGSTAB: "BiCGSTAB"}
# Reflected colours and glow nearer than this to those before are the same.
SAME = 1e-6


class Shown(Protocol):
    """What is read of the preview's objects."""

    baked: BakedTransfer
    key: Hashable
    stale: bool
    direct: Single | None
    moved: NDArray[np.float64] | None


@dataclass
class Edited:
    """One object with edits. baked: with the albedo that it has now; key: of that, changes with it; added: (points,
    rows, 3) to add to what is drawn, for that albedo."""

    baked: BakedTransfer
    key: Hashable
    added: Single
    _joined: tuple[Single | None, Single] | None = None
    _left: tuple[LampScattering, LampScattering] | None = None

    def with_direct(self, direct: Single | None) -> Single:
        """The lamps' direct light and what was added; the same array as long as both are the same."""
        if direct is None:
            return self.added
        if self._joined is None or self._joined[0] is not direct:
            self._joined = direct, direct + self.added
        return self._joined[1]

    def with_scattering(self, scattering: LampScattering | None) -> LampScattering | None:
        """What the graphics card does to `with_direct`: through the body goes the lamps' light alone, as on the
        processor, so that what was added, a glow for one, is taken off what enters; the same one as long as it is."""
        if scattering is None or not scattering.on_card:
            return scattering
        if self._left is None or self._left[0] is not scattering:
            entering = -self.added[:, 0] if scattering.bounced is None else scattering.bounced - self.added[:, 0]
            self._left = scattering, replace(scattering, bounced=entering)
        return self._left[1]


@dataclass
class _Set:
    """The objects of one bake. surfaces: as they were read last, by name; lit: the light then, and the lamps' direct
    light, an array that is another one where it differs; glows: (points,) what arrives of a radiance of 1 of a slot."""

    edits: MaterialEdits
    starts: dict[str, int]
    slots: dict[str, NDArray[np.int32] | None] = field(default_factory=dict)
    glows: dict[tuple[str, int], Single] = field(default_factory=dict)
    surfaces: dict[str, EditedSurfaces] = field(default_factory=dict)
    lit: dict[str, tuple[bytes, Single | None]] = field(default_factory=dict)
    versions: int = 0


@dataclass
class LiveMaterials:
    """All sets of one scene. `edited`: what to draw in place of the baked object, by name; message: for the panel;
    seconds: that the last answer took; answers: so far."""

    edited: dict[str, Edited] = field(default_factory=dict)
    message: str = ""
    seconds: float = 0.0
    answers: int = 0
    _sets: dict[str, _Set] = field(default_factory=dict)
    _tracer: tuple[bytes, Tracer] | None = None  # of everything, with the move of the set that it was made for

    def read(self, shown: Mapping[str, Shown], owners: Mapping[str, bpy.types.Object]) -> None:
        """Find the sets of what is shown. owners: the objects by the same names, none for instances."""
        before, self._sets, self.edited, self.message = self._sets, {}, {}, ""
        members: dict[str, dict[str, int]] = {}
        for name, item in shown.items():
            entry = item.baked.header.get(LIVE_ENTRY)
            if entry is not None and name in owners:
                starts = members.setdefault(str(entry["operator"]), {})
                if entry["start"] not in starts.values():  # a copy: its light is the first one's
                    starts[name] = int(entry["start"])
        for operator, starts in members.items():
            found = before[operator].edits if operator in before else self._make(starts, owners)
            if found is not None and all(start + len(shown[name].baked.positions) <= len(found.operator.albedo)
                                         for name, start in starts.items()):
                self._sets[operator] = _Set(found, starts)

    def _make(self, starts: Mapping[str, int], owners: Mapping[str, bpy.types.Object]) -> MaterialEdits | None:
        """The edits of the set whose form factors one of these objects carries; None where that one is gone."""
        for name in starts:
            mesh = baked_mesh(owners[name])
            try:
                live = None if mesh is None else read_live(mesh, name)
            except PRTError as error:
                self.message = str(error)
                return None
            if live is not None:
                return MaterialEdits(live, *measured_solver(live.matrix))
        self.message = "Bounced light does not follow materials: the object that carries what it needs is not shown"
        return None

    @property
    def present(self) -> bool:
        """Whether anything is followed."""
        return bool(self._sets)

    def follows(self, name: str) -> bool:
        """Whether an object's materials are followed."""
        return any(name in found.starts for found in self._sets.values())

    def forget_geometry(self) -> None:
        """Meshes changed: which face has which material is to be read again."""
        self._tracer = None
        for found in self._sets.values():
            found.slots.clear()
            found.glows.clear()

    def step(self, shown: Mapping[str, Shown], owners: Mapping[str, bpy.types.Object],
             lights: Mapping[str, Single], depsgraph: bpy.types.Depsgraph) -> bool:
        """Follow the materials; whether what is drawn changed. lights: of each object, in its columns."""
        changed = False
        for found in self._sets.values():
            started = time.perf_counter()
            surfaces = self._surfaces(found, shown, owners, depsgraph)
            edited = any(one.changed for one in surfaces.values())
            same = set(surfaces) == set(found.surfaces) and all(
                _same(one, found.surfaces[name]) for name, one in surfaces.items())
            lit = {name: (lights[name].tobytes(), shown[name].direct) for name in found.starts if name in lights}
            if same and (_same_light(lit, found.lit) or not edited):
                continue
            found.lit = lit
            try:
                self._answer(found, shown, surfaces, lights, depsgraph, started)
            except PRTError as error:
                self.message = str(error)
            changed = True
        return changed

    def _surfaces(self, found: _Set, shown: Mapping[str, Shown], owners: Mapping[str, bpy.types.Object],
                  depsgraph: bpy.types.Depsgraph) -> dict[str, EditedSurfaces]:
        """What is followed of the materials of a set's objects as they are now; of stale ones nothing."""
        surfaces = {}
        for name in found.starts:
            if name not in shown or name not in owners or shown[name].stale:
                continue
            baked = shown[name].baked
            if name not in found.slots:
                found.slots[name] = slots_of_receivers(owners[name], baked, depsgraph)
            if found.slots[name] is not None:
                surfaces[name] = edited_surfaces(owners[name], baked, found.slots[name])
        return surfaces

    def _answer(self, found: _Set, shown: Mapping[str, Shown], surfaces: dict[str, EditedSurfaces],
                lights: Mapping[str, Single], depsgraph: bpy.types.Depsgraph, started: float) -> None:
        """Solve for a set's edits and keep what is to be drawn."""
        found.surfaces = surfaces
        if not any(one.changed for one in surfaces.values()):
            for name in found.starts:
                self.edited.pop(name, None)
            self.message, self.answers = "", self.answers + 1
            return
        baked_row, change, emission = _what_changed(found, shown, surfaces, lights)
        before_glow = time.perf_counter()
        glow = self._glow(found, shown, surfaces, len(baked_row), depsgraph)
        started += time.perf_counter() - before_glow  # traced once: what follows shall not wait as long
        added, solution = found.edits.added(change, emission, found.edits.arriving(baked_row), glow)
        found.versions += 1
        for name, start in found.starts.items():
            if name in shown:
                mine = added[start:start + len(shown[name].baked.positions)]
                self._keep(name, shown[name], mine, surfaces.get(name), found.versions)
        self.seconds, self.answers = time.perf_counter() - started, self.answers + 1
        self.message = (f"Bounced light follows materials: {TITLES[solution.method]}, "
                        f"{plural(solution.iterations, 'iteration', 'iterations')}, "
                        f"{self.seconds * 1e3:.0f} ms{_where(found.edits)}")

    def _glow(self, found: _Set, shown: Mapping[str, Shown], surfaces: dict[str, EditedSurfaces], points: int,
              depsgraph: bpy.types.Depsgraph) -> Single | None:
        """(points, 3) what arrives straight from what glows; None where nothing does. Traced once for each slot."""
        glows = {(name, slot): colour for name, one in surfaces.items() for slot, colour in one.glows.items()}
        if not glows:
            return None
        total = np.zeros((points, 3), np.float32)
        for (name, slot), colour in glows.items():
            if (name, slot) not in found.glows:
                found.glows[name, slot] = self._traced_glow(found, shown, name, slot, points, depsgraph)
            total += found.glows[name, slot][:, None] * np.asarray(colour, np.float32)
        return total

    def _traced_glow(self, found: _Set, shown: Mapping[str, Shown], name: str, slot: int, points: int,
                     depsgraph: bpy.types.Depsgraph) -> Single:
        baked, moved = shown[name].baked, shown[name].moved
        chosen = (found.slots[name][baked.triangles] == slot).all(axis=1)
        corners = baked.positions[baked.triangles[chosen]]
        tracer, result = self._traced(depsgraph, moved), np.zeros(points, np.float32)
        for other, start in found.starts.items():
            if other in shown:
                item = shown[other].baked
                result[start:start + len(item.positions)] = glow_of(tracer, item.positions, item.normals,
                                                                    item.triangles, corners, item.faces)
        return result

    def _traced(self, depsgraph: bpy.types.Depsgraph, moved: NDArray[np.float64] | None) -> Tracer:
        """All that casts shadows, where a set saw it that was moved since."""
        key = b"" if moved is None else np.round(moved, 4).tobytes()
        if self._tracer is None or self._tracer[0] != key:
            scene = SceneMesh.assemble(read_objects(depsgraph, None, [], ()), 0.0)
            points = scene.points if moved is None else points_in(scene.points, moved)
            # In Blender's own process nothing starts threads (design/architecture.md).
            self._tracer = key, Tracer(points, scene.triangles, threads=1)
        return self._tracer[1]

    def _keep(self, name: str, item: Shown, added: Single, now: EditedSurfaces | None, version: int) -> None:
        """What is drawn of one object."""
        albedo, glow = (item.baked.albedo, None) if now is None else (now.albedo, now.emission)
        values = np.zeros((len(added), item.baked.bases.shape[2], 3), np.float32)
        values[:, 0] = added
        if glow is not None and glow.any():
            albedo = np.where(glow > 0.0, np.maximum(albedo, LEAST_ALBEDO), albedo)
            values[:, 0] += np.where(glow > 0.0, glow / np.maximum(albedo, LEAST_ALBEDO), np.float32(0.0))
        old = self.edited.get(name)
        if old is not None and np.array_equal(old.baked.albedo, albedo):
            self.edited[name] = Edited(old.baked, old.key, values)
            return
        if np.array_equal(albedo, item.baked.albedo):
            self.edited[name] = Edited(item.baked, item.key, values)
            return
        self.edited[name] = Edited(replace(item.baked, albedo=albedo), (item.key, "edited", version), values)


def _what_changed(found: _Set, shown: Mapping[str, Shown], surfaces: dict[str, EditedSurfaces],
                  lights: Mapping[str, Single]) -> tuple[Single, Single, Single]:
    """The baked diffuse row (points, 3) of a set's objects under the present light; change of albedo since the bake and
    emission (n, 3) of its receivers."""
    points = max(start + len(shown[name].baked.positions) for name, start in found.starts.items() if name in shown)
    baked_row = np.zeros((points, 3), np.float32)
    change, emission = (np.zeros_like(found.edits.operator.albedo) for _ in range(2))
    for name, start in found.starts.items():
        if name in shown and name in lights:
            place = slice(start, start + len(shown[name].baked.positions))
            baked_row[place] = _diffuse_row(shown[name], lights[name])
            if name in surfaces:
                change[place] = surfaces[name].albedo - shown[name].baked.albedo
                emission[place] = surfaces[name].emission
    return baked_row, change, emission


def _where(edits: MaterialEdits) -> str:
    """Who solved, and why, as a clause."""
    if edits.on_gpu is None:
        return ""
    if edits.used_gpu:
        return " on the GPU"
    slower = f": the GPU takes {edits.gpu_cost:.2g} times as long here" if edits.gpu_cost > 1.0 else ""
    return f" on the CPU{slower}"


def _same(one: EditedSurfaces, other: EditedSurfaces) -> bool:
    """Whether nothing that counts differs."""
    return one.changed == other.changed and float(np.abs(one.albedo - other.albedo).max(initial=0.0)) < SAME \
        and float(np.abs(one.emission - other.emission).max(initial=0.0)) < SAME


def _same_light(one: dict[str, tuple[bytes, Single | None]], other: dict[str, tuple[bytes, Single | None]]) -> bool:
    """Whether the light on all objects is the same."""
    return one.keys() == other.keys() and all(
        light == other[name][0] and direct is other[name][1] for name, (light, direct) in one.items())


def _diffuse_row(item: Shown, light: Single) -> Single:
    """The baked diffuse row (points, 3) under the present light, with the lamps' direct light."""
    baked = item.baked
    constants = np.ascontiguousarray(baked_constants(baked, light)[:, :, :1])
    row = exit_radiance(baked.cluster, baked.weights, constants)[:, 0]
    return row if item.direct is None else row + item.direct[:, 0]
