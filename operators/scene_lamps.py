# SPDX-License-Identifier: GPL-3.0-or-later
"""What the scene's lamps do to its baked objects: for the viewport step by step, for commands all at once."""

from __future__ import annotations

from collections.abc import Container, Hashable, Mapping, Sequence
from dataclasses import dataclass, field

import bpy
import numpy as np
from numpy.typing import NDArray

from ..prt_addon.blender.local_lights import read_local_lights
from ..prt_addon.blender.read_scene import read_objects
from ..prt_addon.blender.visibility import render_visible_objects
from ..prt_addon.lighting.lit_surfaces import LitSurfaces, LocalBasis
from ..prt_addon.lighting.local_lights import LocalLight
from ..prt_addon.relighting.lamp_light import (
    AT_ONCE,
    QUICK_SAMPLES,
    SHADOW_SAMPLES,
    CloudLight,
    DirectLight,
    LampLight,
    SurfaceLamps,
    lamp_shape,
    lamps_in,
)
from ..prt_addon.relighting.live_scattering import LiveScattering, bounced_light
from ..prt_addon.relighting.moved_light import lamp_in, points_in
from ..prt_addon.reporting.wording import plural
from ..prt_addon.scene.scene_mesh import SceneMesh
from ..prt_addon.storage.container import BakedTransfer
from ..prt_addon.storage.digests import digest_arrays
from ..prt_addon.tracing.tracer import Tracer
from .distant_lamps import DistantLamps

Move = NDArray[np.float64] | None
Moves = Mapping[str, NDArray[np.float64]]
HIDDEN = "Lamps: all objects that are baked for them are hidden in renders, so they light nothing"
OUTSIDE = "{}: outside the light cloud, so it is shown without bounced light"
UNLIT = "{}: too far from the light cloud's lights in sight for part of the scene's bounced light"


@dataclass
class SceneLamps:
    """Lamps on baked objects. Everything that depends on geometry is kept until `forget_geometry`."""

    _scene: SceneMesh | None = None
    _tracers: dict[bytes, Tracer] = field(default_factory=dict)  # by the move of the bake's set
    _clouds: dict[tuple[str, bytes], LampLight | SurfaceLamps] = field(default_factory=dict)
    _lit: dict[tuple[str, bytes], CloudLight] = field(default_factory=dict)
    _direct: dict[tuple[str, bytes], DirectLight] = field(default_factory=dict)
    _scattering: dict[str, tuple[BakedTransfer, LiveScattering]] = field(default_factory=dict)  # by object
    _keys: dict[int, tuple[LocalBasis, str]] = field(default_factory=dict)  # by the cloud's identity
    far: DistantLamps = field(default_factory=DistantLamps)  # of bakes without columns for lamps

    def forget_geometry(self) -> None:
        """Something moved or changed its shape: shadows are to be found anew."""
        self._scene = None
        self._tracers.clear()
        self._clouds.clear()
        self._direct.clear()
        self._keys.clear()
        self.far.forget_geometry()

    def step(self, baked: dict[str, BakedTransfer], depsgraph: bpy.types.Depsgraph,
             warnings: list[str], seconds: float = AT_ONCE, moves: Moves | None = None,
             owners: Mapping[str, str] | None = None) -> list[LocalLight]:
        """Read the lamps and let their light in each cloud follow; `cloud_light` and `direct` then tell it.

        baked: objects by name; only those with a light cloud count. seconds: since the last step. moves: (4, 4) of each
        object since its bake, where it was moved; owners: full names of the scene's objects that show them, where these
        are others (collection instances). Lamps that are outside a cloud are named in warnings.
        """
        near = {name: b for name, b in baked.items() if b.cloud is not None}
        self._scattering = {name: held for name, held in self._scattering.items() if near.get(name) is held[0]}
        if not near:
            self._lit = {}
            return []
        visible = {found.name for found in render_visible_objects(depsgraph.view_layer).values()}
        shown_by = owners or {}
        casting = list(dict.fromkeys(owner for name in near if (owner := shown_by.get(name, name)) in visible))
        if not casting:
            self._lit = {}
            warnings.append(HIDDEN)
            return []
        lamps = read_local_lights(depsgraph, warnings)
        if self._scene is None:
            self._scene = SceneMesh.assemble(read_objects(depsgraph, casting, []), 0.0)
        self._lit = {}
        for name, transfer in near.items():
            moved = (moves or {}).get(name)
            key = self._cloud_key(transfer), _move_key(moved)
            if key in self._lit:
                continue
            if key not in self._clouds:
                self._clouds[key] = lamps_in(transfer.cloud, self._traced(moved))
            self._lit[key] = self._clouds[key].step(_as_seen(lamps, moved), seconds)
        for found in self._lit.values():
            warnings += [OUTSIDE.format(name) for name in found.outside] + [UNLIT.format(name) for name in found.unlit]
        return lamps

    @property
    def outside(self) -> set[str]:
        """Names of lamps that light without bounces."""
        return {name for found in self._lit.values() for name in found.outside}

    @property
    def settled(self) -> bool:
        """Whether nothing fades any more."""
        return all(found.settled for found in self._lit.values())

    def cloud_light(self, baked: BakedTransfer, moved: Move = None) -> NDArray[np.float32] | None:
        """The lamps' light (zones, columns, 3) in the cloud of a bake, moved since as `step` was told; None without a
        cloud, and where `step` has not heard of it."""
        found = self._lit.get((self._cloud_key(baked), _move_key(moved))) if baked.cloud is not None else None
        return None if found is None else found.values

    def direct(self, name: str, baked: BakedTransfer, lamps: Sequence[LocalLight],
               moving: Container[str] = (), moved: Move = None, scattered: bool = True) -> NDArray[np.float32] | None:
        """The lamps' direct light (points, rows, 3) on a bake's receivers; None without a cloud, or before `step`.

        moving: keys of lamps that are being dragged, whose soft shadows may be coarse. moved: of the object since its
        bake. scattered: whether it goes through translucent bodies, where the bake has links for that.
        """
        if baked.cloud is None or self._scene is None:
            return None
        key = name, _move_key(moved)
        if key not in self._direct:
            self._direct[key] = DirectLight(self._traced(moved), baked)
        samples = [QUICK_SAMPLES if lamp.key in moving else SHADOW_SAMPLES for lamp in lamps]
        found = self._direct[key].of(_as_seen(lamps, moved), samples)
        if not scattered or baked.links is None or not lamps:
            return found
        return self.scattering(name, baked).added(found, self.bounced(baked, moved))

    def bounced(self, baked: BakedTransfer, moved: Move = None) -> NDArray[np.float32] | None:
        """The lamps' light on a bake's receivers by way of the scene, E / pi (points, 3); None for none."""
        return bounced_light(baked, self.cloud_light(baked, moved))

    def scattering(self, name: str, baked: BakedTransfer) -> LiveScattering:
        """What takes the lamps' light through an object's translucent bodies; made once."""
        held = self._scattering.get(name)
        if held is None or held[0] is not baked:
            held = self._scattering[name] = baked, LiveScattering(baked)
        return held[1]

    def known_scattering(self, name: str) -> LiveScattering | None:
        """The same, where it was made."""
        held = self._scattering.get(name)
        return None if held is None else held[1]

    def _cloud_key(self, baked: BakedTransfer) -> str:
        """`cloud_key`, computed once: redraws ask for it."""
        held = self._keys.get(id(baked.cloud))
        if held is None or held[0] is not baked.cloud:
            held = self._keys[id(baked.cloud)] = baked.cloud, cloud_key(baked)
        return held[1]

    def _traced(self, moved: Move) -> Tracer:
        """Of everything that casts shadows, where the bake saw it."""
        key = _move_key(moved)
        if key not in self._tracers:
            points = self._scene.points if moved is None else points_in(self._scene.points, moved)
            # In Blender's own process nothing starts threads (design/architecture.md).
            self._tracers[key] = Tracer(points, self._scene.triangles, threads=1)
        return self._tracers[key]


def _move_key(moved: Move) -> bytes:
    """The same for the same move of a whole set: its objects' own transforms round differently."""
    return b"" if moved is None or np.array_equal(moved, np.eye(4)) else np.round(moved, 4).tobytes()


def _as_seen(lamps: Sequence[LocalLight], moved: Move) -> Sequence[LocalLight]:
    """Lamps as a bake sees them that was moved."""
    return lamps if moved is None else [lamp_in(lamp, moved) for lamp in lamps]


def lamps_signature(lamps: Sequence[LocalLight]) -> Hashable:
    """Changes when a lamp does."""
    return tuple((lamp.key, lamp_shape(lamp), lamp.power.tobytes()) for lamp in lamps)


def moved_lamps(lamps: Sequence[LocalLight], before: Sequence[LocalLight]) -> set[str]:
    """Keys of lamps with soft shadows that are elsewhere, or of another shape, than before. New ones are not."""
    shapes = {lamp.key: lamp_shape(lamp) for lamp in before}
    return {lamp.key for lamp in lamps if lamp.extent > 0.0 and shapes.get(lamp.key, lamp_shape(lamp))
            != lamp_shape(lamp)}


def cloud_key(baked: BakedTransfer) -> str:
    """The same for bakes with the same light cloud or lit surfaces."""
    if isinstance(baked.cloud, LitSurfaces):
        return digest_arrays(baked.cloud.corners, baked.cloud.patch, baked.cloud.axes)
    return digest_arrays(baked.cloud.positions, baked.cloud.zone_starts, baked.cloud.dense)


def cloud_lines(cloud: LocalBasis) -> str:
    """What a light cloud is, or lit surfaces are, in short lines for the panel."""
    if isinstance(cloud, LitSurfaces):
        return (f"{plural(cloud.axes.shape[1], 'patch', 'patches')} of lit surfaces\n"
                f"{plural(len(cloud.corners), 'triangle', 'triangles')}\n{plural(cloud.columns, 'column', 'columns')}")
    kept = np.diff(cloud.zone_starts)
    merged = f"{kept.min()}" if kept.min() == kept.max() else f"{kept.min()} to {kept.max()}"
    zones = "1 zone" if len(kept) == 1 else f"{len(kept)} zones"
    functions = cloud.emission_order ** 2
    each = "" if functions == 1 else f", {functions} for each light"
    return (f"{plural(len(cloud.dense), 'light', 'lights')} every {cloud.spacing:.3g} m\n"
            f"merged to {merged} in {zones}\n{plural(cloud.columns, 'column', 'columns')}{each}")
