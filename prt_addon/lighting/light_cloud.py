# SPDX-License-Identifier: GPL-3.0-or-later
"""A cloud of local lights (Kristensen et al. 2005, section 4): what it is, and where the lights of a dense one lie.

A light of the cloud is an isotropic point of radiant intensity 1 W/sr, or emits sqrt(4 pi) y_k(direction) W/sr for each
function k of real spherical harmonics below the emission order, so that k = 0 is the isotropic light again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import BadArguments, BadScene
from ..tracing.tracer import Tracer
from .light_visibility import surroundings

MOST_LIGHTS = 4096
# Places of a grid that are looked at; more than this of a region in solid bodies is no region for lights.
MOST_PLACES = 16 * MOST_LIGHTS
# Least distance from a surface as a fraction of the spacing. The first light of a grid stands half a spacing from its
# region's border; one much nearer to a wall than its neighbours says little about the space between them, as the wall
# next to it is lit in a small spot.
CLEARANCE = 0.25
# Shortest side of the free space as a fraction of the longest: a lone floor has room for lights above it.
FLATTEST = 0.1
# A side of s spacings has floor(s + this) cells: not the same on all axes, so that a cube can have 6 x 6 x 5 lights.
ROUNDING = np.array([0.5, 0.6, 0.4])
# How far the default region reaches beyond lamps near its border or outside, as a fraction of the scene's diagonal:
# they are there to be moved.
REACH = 0.05
# Steps of the search for the spacing that gives a wanted number of lights.
STEPS = 12


@dataclass(frozen=True, eq=False)
class LightCloud:
    """positions: (lights, 3) float64, metres, world space, of all zones one after the other; zone_starts: (zones + 1,)
    int, where each zone's lights start; emission_order: bands of a light's directional emission, 1 for isotropic;
    dense: (d, 3) the lights before merging; spacing: metres between these; radius: of diffuse spheres, 0 for points."""

    positions: NDArray[np.float64]
    zone_starts: NDArray[np.integer]
    emission_order: int
    dense: NDArray[np.float64]
    spacing: float
    radius: float = 0.0

    @staticmethod
    def of_zones(zones: Sequence[NDArray[np.float64]], dense: NDArray[np.float64], spacing: float,
                 emission_order: int = 1, radius: float = 0.0) -> LightCloud:
        """The cloud whose zones have lights at these positions (n_i, 3)."""
        starts = np.concatenate([[0], np.cumsum([len(z) for z in zones])]).astype(np.int64)
        positions = np.concatenate([np.asarray(z, np.float64).reshape(-1, 3) for z in zones] or [np.zeros((0, 3))])
        return LightCloud(positions, starts, emission_order, np.asarray(dense, np.float64), float(spacing), radius)

    @property
    def zones(self) -> int:
        """How many zones there are."""
        return len(self.zone_starts) - 1

    @property
    def most_lights(self) -> int:
        """Lights of the zone that has most of them."""
        return int(np.diff(self.zone_starts).max(initial=0))

    @property
    def columns(self) -> int:
        """Columns of the transfer: the same in all zones, zones of fewer lights leave their last ones zero."""
        return self.most_lights * self.emission_order ** 2

    def lights_of(self, zone: int) -> NDArray[np.float64]:
        """Positions (n, 3) of a zone's lights."""
        return self.positions[self.zone_starts[zone]:self.zone_starts[zone + 1]]

    def columns_of(self, zone: int, light: int) -> slice:
        """The columns of a zone's light, one for each function of its emission."""
        count = int(self.zone_starts[zone + 1] - self.zone_starts[zone])
        if not 0 <= light < count:
            raise IndexError(f"light {light} of zone {zone}, which has {count}")
        functions = self.emission_order ** 2
        return slice(light * functions, (light + 1) * functions)


@dataclass(frozen=True)
class PlacedLights:
    """positions: (n, 3) float64, metres, world space; spacing: metres between neighbours along the axis where they lie
    farthest apart; inside, near: how many places were left out because they lie in a body or too near to a surface;
    warnings: one line each."""

    positions: NDArray[np.float64]
    spacing: float
    inside: int = 0
    near: int = 0
    warnings: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.positions)


def box_matrix(low: ArrayLike, high: ArrayLike) -> NDArray[np.float64]:
    """The matrix (4, 4) that makes of the cube [-1, 1]^3 the box between two corners (3,)."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    matrix = np.diag([*(0.5 * (high - low)), 1.0])
    matrix[:3, 3] = 0.5 * (low + high)
    return matrix


def free_space(points: NDArray[np.float64], lamps: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """The default region: the box (4, 4) around a scene's points (p, 3), made thicker where it is flat.

    lamps: (n, 3) positions that it shall reach to and beyond by REACH of its size; those farther away than the scene is
    wide would thin the cloud out and are left outside.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    if lamps is not None and len(lamps):
        size = np.sqrt(np.sum((high - low) ** 2))
        margin = REACH * size
        near = lamps[((lamps > low - size) & (lamps < high + size)).all(axis=1)]
        inside = ((near > low + margin) & (near < high - margin)).all(axis=1)
        for lamp in near[~inside]:
            low, high = np.minimum(low, lamp - margin), np.maximum(high, lamp + margin)
    missing = 0.5 * np.maximum(FLATTEST * (high - low).max() - (high - low), 0.0)
    return box_matrix(low - missing, high + missing)


def place_lights(tracer: Tracer, boxes: ArrayLike | Sequence[ArrayLike], spacing: float = 0.0, count: int = 0,
                 clearance: float | None = None, radius: float = 0.0,
                 volumes: Sequence[tuple[NDArray[np.float64], NDArray[np.int32]]] = ()) -> PlacedLights:
    """A uniform sampling of regions by lights, out of bodies and clear of surfaces.

    boxes: (4, 4) matrices that make boxes of the cube [-1, 1]^3, or (2, 3) low and high corners; volumes: points
    (p, 3) and triangles (t, 3) of closed meshes whose inside is a region, too. spacing: metres; or count: most lights,
    as near to it as a grid allows. clearance: metres from surfaces, at least; None for CLEARANCE of the spacing.
    radius: of spheres, which must not touch surfaces either.

    Each region gets a grid of its own along its own axes, its places in the middle of equal cells; what lies in an
    earlier region, too, is left out. Raises BadArguments for a spacing that makes more than MOST_LIGHTS, and BadScene
    where no light fits.
    """
    regions = [_Region(_as_matrix(box)) for box in boxes] + [_volume(*mesh) for mesh in volumes]
    if not regions:
        raise BadArguments("light cloud", "it has no region", "Name a box empty or a mesh, or use the free space")
    if not 0.0 < spacing < math.inf and not 1 <= count <= MOST_LIGHTS:
        raise BadArguments("light cloud", f"{count} lights or a spacing of {spacing} m can't be placed",
                           f"Use 1 to {MOST_LIGHTS} lights, or a spacing above 0")
    if spacing > 0.0:
        placed = _place(tracer, regions, spacing, clearance, radius)
    else:
        placed = _place_count(tracer, regions, count, clearance, radius)
    if len(placed) > MOST_LIGHTS:
        raise _too_many(len(placed), spacing)
    if not len(placed):
        raise BadScene("light cloud", f"no light fits: {placed.inside} places lie in bodies, {placed.near} too near to "
                       "surfaces", "Move or enlarge its region, or take a smaller spacing or more lights")
    return placed


@dataclass(frozen=True)
class _Region:
    """A box, the cube [-1, 1]^3 under a matrix (4, 4), and where given the part of it inside a closed mesh."""

    matrix: NDArray[np.float64]
    mesh: Tracer | None = None

    @property
    def sides(self) -> NDArray[np.float64]:
        """Lengths (3,) of the box's sides, metres."""
        return 2.0 * np.sqrt(np.sum(self.matrix[:3, :3] ** 2, axis=0))

    def cells(self, spacing: float) -> NDArray[np.int64]:
        """Cells (3,) of the grid along each side."""
        return np.maximum(np.floor(np.minimum(self.sides / spacing, MOST_PLACES) + ROUNDING), 1).astype(np.int64)

    def grid(self, spacing: float) -> NDArray[np.float64]:
        """Middles (n, 3) of the cells, world space."""
        lines = [(2.0 * np.arange(n) + 1.0) / n - 1.0 for n in self.cells(spacing)]
        local = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
        places = self.matrix[:3, 3] + local @ self.matrix[:3, :3].T  # small
        return places if self.mesh is None else places[self.contains(places)]

    def contains(self, places: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether places (n, 3) lie in the region; a box without volume contains nothing."""
        if self.mesh is not None:
            return surroundings(self.mesh, places).inside
        axes = self.matrix[:3, :3]
        if np.linalg.cond(axes) > 1e12:  # small
            return np.zeros(len(places), bool)
        local = (places - self.matrix[:3, 3]) @ np.linalg.inv(axes).T  # small
        return (np.abs(local) <= 1.0).all(axis=1)


def _as_matrix(box: ArrayLike) -> NDArray[np.float64]:
    """A box's matrix (4, 4) of its matrix or its corners (2, 3)."""
    box = np.asarray(box, np.float64)
    if box.shape not in ((4, 4), (2, 3)) or not np.isfinite(box).all():
        raise BadArguments("light cloud", "a box of its region has no finite size", "Give the box a size")
    return box if len(box) == 4 else box_matrix(*box)


def _volume(points: NDArray[np.float64], triangles: NDArray[np.int32]) -> _Region:
    """The region inside a closed mesh."""
    if not len(triangles) or not np.isfinite(points).all():
        raise BadArguments("light cloud", "a mesh of its region has no faces", "Name a closed mesh or a box empty")
    return _Region(box_matrix(points.min(axis=0), points.max(axis=0)), Tracer(points, triangles, 1))


def _too_many(count: int, spacing: float) -> BadArguments:
    factor = (count / MOST_LIGHTS) ** (1.0 / 3.0)
    return BadArguments("light cloud", f"a spacing of {spacing:g} m makes {count} lights, of which {MOST_LIGHTS} fit",
                        f"Use a spacing of {1.05 * factor * spacing:.2g} m or more, or a smaller region")


def _place(tracer: Tracer, regions: list[_Region], spacing: float, clearance: float | None,
           radius: float) -> PlacedLights:
    """The lights of all regions at about this spacing."""
    if _places(regions, spacing) > MOST_PLACES:
        raise _too_many(_places(regions, spacing), spacing)
    grids: list[NDArray[np.float64]] = []
    for region in regions:
        grid = region.grid(spacing)
        for earlier in regions[:len(grids)]:
            grid = grid[~earlier.contains(grid)]
        grids.append(grid)
    places = np.concatenate(grids)
    widest = max(float((region.sides / region.cells(spacing)).max()) for region in regions)
    around = surroundings(tracer, places)
    # A hair less, so that a wall at just that distance, as a region's own border may be, does not decide by rounding.
    least = (1.0 - 1e-4) * max(CLEARANCE * min(widest, spacing) if clearance is None else clearance, radius)
    near, inside, warnings = around.clearance < least, around.inside, ()
    if len(places) and (inside | near).all() and (inside & ~near).any():
        # A room that is wound outwards shows nothing but backs, and no place outside of it is in the region.
        warnings = ("light cloud: all of its region shows the backs of faces; taken for a room that faces outwards",)
        inside = np.zeros(len(places), bool)
    return PlacedLights(places[~(inside | near)], widest, int(inside.sum()), int((near & ~inside).sum()), warnings)


def _place_count(tracer: Tracer, regions: list[_Region], count: int, clearance: float | None,
                 radius: float) -> PlacedLights:
    """At most `count` lights, as many as a search for the spacing finds: first by the ratio of lights found to wanted,
    then by halving between a spacing that gives too many and one that does not. The number moves in jumps."""
    spacing, small, large = _spacing_of(regions, count), 0.0, math.inf
    best, surplus = PlacedLights(np.zeros((0, 3)), spacing), None
    for _ in range(STEPS):
        number = _places(regions, spacing)
        if number <= max(16 * count, 1024):  # else most of the region is solid, or the guess was far off
            found = _place(tracer, regions, spacing, clearance, radius)
            number = len(found)
            if number > count:
                surplus = found if surplus is None or number < len(surplus) else surplus
            elif number > len(best) or not len(best):
                best = found
        if number == count:
            break
        small, large = (spacing, large) if number > count else (small, spacing)
        if small > 0.0 and large < math.inf:
            spacing = math.sqrt(small * large)
        else:
            spacing *= float(np.clip((number + 0.25) / (count + 0.5), 0.1, 10.0)) ** (1.0 / 3.0)
    if 2 * len(best) < count and surplus is not None:  # a few lights are worth more than an even grid
        chosen = (2 * np.arange(count) + 1) * len(surplus) // (2 * count)
        return replace(surplus, positions=surplus.positions[chosen])
    return best


def _places(regions: list[_Region], spacing: float) -> int:
    """Cells of all regions' grids."""
    return int(sum(np.prod(region.cells(spacing).astype(float)) for region in regions))


def _spacing_of(regions: list[_Region], count: int) -> float:
    """The spacing at which all regions together have about `count` cells, metres."""
    volume, dimensions = 0.0, 0
    for region in regions:
        sides = region.sides
        sides = sides[sides > 1e-9 * max(float(sides.max()), np.finfo(np.float64).tiny)]
        if len(sides) >= dimensions:
            volume = volume * (len(sides) == dimensions) + float(np.prod(sides))
            dimensions = len(sides)
    return (volume / count) ** (1.0 / dimensions) if dimensions and volume > 0.0 else 1.0
