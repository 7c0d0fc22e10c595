# SPDX-License-Identifier: GPL-3.0-or-later
"""Direct light of real lamps at receivers, exact up to the sampling of soft shadows: E / pi, for unit albedo.

The light clouds store bounced light only (Kristensen et al. 2005, section 3); what a lamp sends straight to a surface
is sharper than any cloud and cheap: one shadow ray per receiver and lamp, some more for soft shadows. The unshadowed
irradiance comes from closed forms and rays only say which share of it is seen, so a receiver in the open has no noise.

Everything runs in the tracer's space (unit diagonal), where single precision serves every scene alike.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..basis.directions import cosine_hemisphere, tangent_frames
from ..basis.point_sets import fibonacci_disc, fibonacci_square
from ..lighting.local_lights import LEAST_SPREAD, LocalLight, spot_pattern, spread_pattern
from ..linear_algebra import multiply
from ..scene.receivers import LIFT, ray_origins
from ..tracing.tracer import Tracer
from ..transport.receiver_set import ReceiverSet
from .source_irradiance import cap_irradiance, polygon_irradiance

Single = NDArray[np.float32]

# Receivers per task: their arrays stay in the cache; tasks enough for the threads at 50,000 receivers.
BLOCK = 4096
# A lamp nearer than this is held at it: single precision knows no smaller distance inside the scene's unit box.
NEAREST = 6e-8
# A lamp farther away, in diagonals of the scene, gives nothing: 1e9 W would give a scene of a millimetre 1e-17 W/m^2;
# squares of still larger distances leave single precision.
FARTHEST = 1e15
# The share of a ball's radius by which rounding may put a receiver on its surface inside or outside of it.
SURFACE = 1e-5
# Points without rays by which a spot's edge across a wide lamp, and a grid's shade on an Area, are integrated: FINE
# where the light leaps between them, SMOOTH where it does not.
FINE, SMOOTH = 192, 32
# Such points taken at once: fewer calls of numpy, and the arrays stay in the cache.
AT_ONCE = 8
# Within this many half widths of an Area its irradiance comes from Lambert's formula; beyond, four points that are
# exact for polynomials of degree 3 are within 1e-3 of that.
NEAR = 5.0
FAR_POINTS = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]], np.float32)
FAR_REACH = {"rectangle": math.sqrt(1.0 / 3.0), "ellipse": 0.5}
# Sides of the polygon of equal area that stands for an ellipse there.
SIDES = 16


@dataclass(frozen=True)
class LitReceivers:
    """p receivers as local lights see them.

    origins: (p, 3) in tracing space, where rays start; places, normals: (3, p), the same by axes, and unit normals;
    faces: who knows the receivers' own faces, or None.
    """

    origins: Single
    places: Single
    normals: Single
    faces: ReceiverSet | None = None

    @staticmethod
    def of_set(receivers: ReceiverSet) -> LitReceivers:
        """The bake's receivers, with their faces' horizons."""
        return LitReceivers(receivers.origins, _by_axis(receivers.origins), _by_axis(receivers.normals), receivers)

    @staticmethod
    def of_points(tracer: Tracer, positions: ArrayLike, normals: ArrayLike) -> LitReceivers:
        """Receivers at world positions (p, 3) with unit normals (p, 3), lifted off their surface by the bake's least
        height. On concave edges `of_set` does better: it also knows the way into the receiver's own faces."""
        normals = np.asarray(normals, np.float64)
        lifted = np.asarray(positions, np.float64) + (LIFT * tracer.diagonal) * normals
        origins = tracer.to_tracing_space(lifted)
        return LitReceivers(origins, _by_axis(origins), _by_axis(normals))

    @staticmethod
    def of_mesh(tracer: Tracer, positions: ArrayLike, normals: ArrayLike, triangles: NDArray[np.int32],
                faces: NDArray[np.floating] | None = None) -> LitReceivers:
        """The same for the vertices of triangles (t, 3): pulled into their faces as in the bake, or the corners of a
        room would be dark. faces: (p, 3) of texels, see `ray_origins`."""
        normals = np.asarray(normals, np.float64)
        starts = ray_origins(np.asarray(positions, np.float64), normals, triangles, tracer.diagonal,
                             faces=faces)
        origins = tracer.to_tracing_space(starts)
        return LitReceivers(origins, _by_axis(origins), _by_axis(normals))

    def taken(self, order: NDArray[np.integer]) -> LitReceivers:
        """The receivers in this order, without their faces."""
        return LitReceivers(np.ascontiguousarray(self.origins[order]), np.ascontiguousarray(self.places[:, order]),
                            np.ascontiguousarray(self.normals[:, order]))

    def __len__(self) -> int:
        return len(self.origins)


def direct_local_light(tracer: Tracer, receivers: LitReceivers | ReceiverSet, lights: Sequence[LocalLight],
                       samples: int = 16, seed: int = 0, cutoff: float = 0.0) -> Single:
    """E / pi (p, 3) float32 of the lamps at the receivers, in their order, shadows included.

    samples: points of a lamp that throws soft shadows, fewer of one that is small from where the receivers are
    (`sample_count`), the same for every receiver, so nothing flickers as a lamp moves; seed: turns the point sets.
    cutoff: what a lamp would give unshadowed below this is left out (the error is at most that for each lamp). The
    result does not depend on threads or blocks. Receivers in Morton order are traced faster.
    """
    if isinstance(receivers, ReceiverSet):
        receivers = LitReceivers.of_set(receivers)
    result = np.zeros((len(receivers), 3), np.float32)
    sources = [_Source.of(light, tracer, receivers, samples, seed, cutoff) for light in lights]
    sources = [source for source in sources if np.any(source.colour != 0.0)]
    places = [slice(start, min(start + BLOCK, len(receivers))) for start in range(0, len(receivers), BLOCK)]
    if not sources:
        return result

    def work(place: slice) -> tuple[Single, int]:
        return _lit_block(tracer, receivers, place, sources)

    for place, (light, rays) in _in_threads(tracer, work, places):
        result[place] = light
        tracer.rays += rays
    return result


def sample_count(extent: float, distance: float, samples: int) -> int:
    """Points for a lamp of this half width seen from a typical distance: 1 for none, all of them from a tenth of the
    distance on, at least 4 where it throws any soft shadow. The sides of a penumbra show 1 / count steps of the light,
    and a lamp half as wide throws one half as wide. In halves, because every other count is another set of points, at
    which a shadow leaps while the lamp moves."""
    if extent <= 0.0 or samples <= 1:
        return 1
    wanted = samples * min(1.0, 10.0 * extent / max(distance, 1e-30))
    while samples >= 8 and 0.5 * samples >= wanted:
        samples //= 2
    return samples


def has_grid(light: LocalLight) -> bool:
    """Whether an Area light's spread is less than all directions."""
    return light.kind == "area" and light.spread < math.pi - 2e-6


def _by_axis(vectors: NDArray[np.floating]) -> Single:
    return np.ascontiguousarray(np.asarray(vectors).T, np.float32)


def _in_threads(tracer: Tracer, work: Callable, items: list) -> Iterable:
    """`map_in_order`, without starting threads where one would do the work (in Blender's own process none may run)."""
    if tracer.threads == 1 or len(items) == 1:
        return ((item, work(item)) for item in items)
    return tracer.map_in_order(work, items)


@dataclass(frozen=True, eq=False)
class _Source:
    """A lamp in tracing space. colour: (3,) float64, what one unit of `_Aimed.unshadowed` is worth; least: the smallest
    such unit that counts; points: (n, 2) of its unit disc or square; fine, smooth: more of them, see above; stretch:
    the largest over the least that its scale does to a length."""

    light: LocalLight
    centre: Single
    axis: Single
    half_axes: Single
    to_local: Single
    stretch: float
    radius: float
    extent: float
    colour: NDArray[np.float64]
    least: float
    points: Single
    fine: Single
    smooth: Single

    @staticmethod
    def of(light: LocalLight, tracer: Tracer, receivers: LitReceivers, samples: int, seed: int,
           cutoff: float) -> _Source:
        """Bring a lamp to tracing space. Irradiance of a unit there is 1 / diagonal^2 of one in the world."""
        with np.errstate(over="ignore", invalid="ignore"):
            centre = tracer.to_tracing_space(light.position[None])[0]
        lost = not np.all(np.abs(centre) < FARTHEST)
        if lost:
            centre = np.zeros(3, np.float32)
        extent = light.extent / tracer.diagonal
        if extent < NEAREST:
            extent = 0.0  # thinner than single precision tells apart: a point
        some = receivers.places[:, ::max(1, len(receivers) // 512)]
        typical = float(np.median(_length(some - centre[:, None]))) if some.size else 0.0
        count = sample_count(extent, typical, samples)
        # what a grid lets be seen of an ellipse is cut out of a rectangle (`_Face`)
        square = light.kind == "area" and (light.shape == "rectangle" or has_grid(light))
        spread = fibonacci_square if square else fibonacci_disc
        # E / pi = I cos / (pi d^2), for every kind of lamp from afar
        colour = light.peak_intensity * (0.0 if lost else 1.0 / (math.pi * tracer.diagonal ** 2))
        brightest = float(np.max(np.abs(colour), initial=0.0))
        scale = float(np.sqrt(np.sum(light.to_local ** 2)))
        return _Source(light, centre, light.axis.astype(np.float32),
                       (light.half_axes / tracer.diagonal).astype(np.float32),
                       (light.to_local / scale).astype(np.float32), float(np.linalg.cond(light.to_local)),  # small
                       extent if light.kind != "area" else 0.0, extent, colour,
                       cutoff / brightest if brightest > 0.0 else 0.0,
                       *(spread(number, seed).astype(np.float32) for number in (count, FINE, SMOOTH)))


@dataclass(frozen=True)
class _Aimed:
    """Where to look for a lamp from the c receivers (indices `chosen` of the block) that it could reach.

    unshadowed: (c,) what it gives in the open; directions: (n, c, 3) to its points; weights: (n, c) their share in
    that, up to a factor for each receiver.
    """

    chosen: NDArray[np.int64]
    unshadowed: Single
    directions: Single
    weights: Single


def _lit_block(tracer: Tracer, receivers: LitReceivers, place: slice, sources: list[_Source]) -> tuple[Single, int]:
    """E / pi (b, 3) of a block of receivers and the number of rays."""
    places, normals = receivers.places[:, place], receivers.normals[:, place]
    result = np.zeros((places.shape[1], 3))
    rays = 0
    for source in sources:
        aimed = _aim(source, places, normals)
        if not len(aimed.chosen):
            continue
        seen, traced = _seen(tracer, receivers, place, aimed, source.light.shadow)
        rays += traced
        result[aimed.chosen] += (aimed.unshadowed * seen)[:, None] * source.colour
    # 1e9 W in a scene of a micrometre can leave single precision: the largest number, not infinity, which spreads NaN.
    limit = float(np.finfo(np.float32).max)
    return np.clip(result, -limit, limit).astype(np.float32), rays


def _seen(tracer: Tracer, receivers: LitReceivers, place: slice, aimed: _Aimed, shadow: bool) -> tuple[Single, int]:
    """The share (c,) of the lamp that each chosen receiver sees, and the number of rays."""
    origins = receivers.origins[place][aimed.chosen]
    got, whole = np.zeros(len(aimed.chosen), np.float32), np.zeros(len(aimed.chosen), np.float32)
    rays = 0
    for towards, weights in zip(aimed.directions, aimed.weights, strict=True):
        whole += weights
        kept = weights.copy()
        if shadow:
            lit = np.flatnonzero(kept > 0.0)
            some = towards if len(lit) == len(kept) else towards[lit]
            # A lamp that lies in a surface still lights the rest: rays end as far before it as they start off theirs.
            reach = np.maximum(1.0 - LIFT / np.maximum(_length(some.T), LIFT), 0.0).astype(np.float32)
            rays += len(lit)
            kept[lit[tracer.occluded(origins if some is towards else origins[lit], some, reach)]] = 0.0
        if receivers.faces is not None:
            _weigh_by_faces(receivers.faces, aimed.chosen + place.start, towards, kept)
        got += kept
    return np.divide(got, whole, out=np.zeros_like(got), where=whole > 0.0), rays


def _weigh_by_faces(receivers: ReceiverSet, chosen: NDArray[np.int64], towards: Single, weights: Single) -> None:
    """Multiply weights (c,), in place, by the share of the receivers' faces that the directions (c, 3) lie above."""
    lit = np.flatnonzero(weights > 0.0)
    some = towards[lit]
    height = np.sum(some * receivers.normals[chosen[lit]], axis=1)
    low = lit[height < receivers.grazing[chosen[lit]] * _length(some.T)]
    if len(low):
        weights[low] *= receivers.above_faces(chosen[low], towards[low])


def _aim(source: _Source, places: Single, normals: Single) -> _Aimed:
    """What to trace for a lamp from the receivers of a block, by its kind."""
    if source.light.kind == "area":
        return _aim_at_face(source, places, normals)
    towards = source.centre[:, None] - places
    distance = np.maximum(_length(towards), NEAREST)
    height = towards[0] * normals[0] + towards[1] * normals[1] + towards[2] * normals[2]
    if source.radius == 0.0:
        return _aim_at_point(source, towards, distance, height)
    return _aim_at_sphere(source, towards, distance, height, normals)


def _aim_at_point(source: _Source, towards: Single, distance: Single, height: Single) -> _Aimed:
    """A lamp without extent: intensity cos / d^2."""
    value = np.maximum(height, 0.0) / distance / (distance * distance)
    if source.light.kind == "spot":
        value *= _spot_share(source, towards)
    chosen = np.flatnonzero(value > source.least)
    value = value[chosen]
    directions = np.ascontiguousarray(np.take(towards, chosen, axis=1).T)
    return _Aimed(chosen, value, directions[None], np.ones((1, len(chosen)), np.float32))


def _aim_at_sphere(source: _Source, towards: Single, distance: Single, height: Single, normals: Single) -> _Aimed:
    """A lamp with a radius: the disc that faces the receiver, or a sphere, which looks like the disc within its rim.

    Both fill a round spot of the sky of angular radius a evenly: sin^2(a) is r^2 / (d^2 + r^2) or r^2 / d^2.
    """
    radius = source.radius
    soft = source.light.soft_falloff
    square = distance.astype(np.float64) ** 2
    sine_squared = radius ** 2 / (square + radius ** 2) if soft else np.minimum(radius ** 2 / square, 1.0)
    value = cap_irradiance(sine_squared, np.clip(height / distance, -1.0, 1.0).astype(np.float64))
    inside = np.zeros(len(distance), bool) if soft else distance < radius * (1.0 + SURFACE)
    value[inside] = math.pi  # the sphere shines on both sides: all around the receiver
    value /= math.pi * radius ** 2
    chosen = np.flatnonzero(value > source.least)
    if source.light.kind == "spot":
        dark, sharp, soft_edge = _cone_edges(source, np.take(towards, chosen, axis=1), sine_squared[chosen])
        ball = inside[chosen]  # where it has no cone (Cycles: half of one, see the tests)
        kept = ~dark | ball
        chosen, edges = chosen[kept], [(edge & ~ball)[kept] for edge in (sharp, soft_edge)]
    if not len(chosen):
        return _nothing()
    far, middle = distance[chosen], np.take(towards, chosen, axis=1).T
    within = np.zeros_like(far) if soft else np.minimum(radius * radius / far, far)
    rim = np.full_like(far, radius) if soft else radius * np.sqrt(np.maximum(1.0 - (radius / far) ** 2, 0.0))
    frames = tangent_frames((middle / far[:, None]).astype(np.float64)).astype(np.float32)
    to_disc = far - within
    directions = _disc_points(frames, to_disc, rim, source.points)
    facing = np.ascontiguousarray(np.take(normals, chosen, axis=1).T)
    square = _squares(directions)
    weights = _heights(directions, facing) / square * (to_disc / square)
    where = np.flatnonzero(inside[chosen])
    if len(where):
        _aim_from_inside(source, where, middle[where], facing[where], directions, weights)
    value = value[chosen].astype(np.float32)
    for edge, rule in zip(edges, (source.fine, source.smooth), strict=True) if source.light.kind == "spot" else ():
        some = np.flatnonzero(edge)
        if not len(some):
            continue
        value[some] *= _spot_edge(source, rule, frames[some], to_disc[some], rim[some], facing[some])
        parted = directions[:, some]
        weights[:, some] *= _spot_share(source, parted.reshape(-1, 3).T).reshape(parted.shape[:2])
    return _Aimed(chosen, value, directions, weights)


def _disc_points(frames: Single, distance: Single, radius: Single, points: Single) -> Single:
    """Vectors (n, c, 3) from receivers to points (n, 2) of discs that face them; frames: (c, 3, 3), third row to it."""
    middle = frames[:, 2] * distance[:, None]
    first, second = frames[:, 0] * radius[:, None], frames[:, 1] * radius[:, None]
    return middle + points[:, 0, None, None] * first + points[:, 1, None, None] * second


def _aim_from_inside(source: _Source, where: NDArray[np.int64], middle: Single, normals: Single, directions: Single,
                     weights: Single) -> None:
    """From inside a shining sphere: look through the whole hemisphere up to the sphere. Changes entries `where`."""
    local = cosine_hemisphere(len(directions))
    frames = tangent_frames(normals.astype(np.float64))
    for index, direction in enumerate(local):
        ray = direction[0] * frames[:, 0] + direction[1] * frames[:, 1] + direction[2] * frames[:, 2]
        along = np.sum(ray * middle, axis=1)
        away = np.maximum(source.radius ** 2 - np.sum(middle.astype(np.float64) ** 2, axis=1), 0.0)
        directions[index, where] = ray * (along + np.sqrt(along ** 2 + away))[:, None]
        weights[index, where] = 1.0


def _spot_share(source: _Source, towards: Single) -> Single:
    """A spot's intensity towards receivers as a share of its peak; towards: (3, n), from receivers to the lamp."""
    return spot_pattern(_spot_cosine(source, towards), source.light.spot_angle, source.light.spot_blend)


def _spot_cosine(source: _Source, towards: Single) -> Single:
    """The cosine to a spot's axis in its own space."""
    rows = source.to_local
    x, y, z = (rows[k, 0] * towards[0] + rows[k, 1] * towards[1] + rows[k, 2] * towards[2] for k in range(3))
    length = np.sqrt(x * x + y * y + z * z)
    # towards the receiver is the other way, and the lamp looks along -Z: two signs that cancel
    return np.divide(z, length, out=np.zeros_like(length), where=length > 0.0)


def _cone_edges(source: _Source, towards: Single, sine_squared: NDArray[np.float64],
                ) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Which receivers (c,) are wholly outside a wide spot's cone, and which neither outside nor wholly in full light:
    those for which the lamp is wider than the cone's blend, and the others.

    towards: (3, c), to the lamp's middle; sine_squared: (c,) of the angle that its radius fills, which the lamp's scale
    widens in its own space at most by the ratio of its stretches.
    """
    light = source.light
    angle = np.arccos(np.clip(_spot_cosine(source, towards), -1.0, 1.0))
    wide = source.stretch * np.arcsin(np.sqrt(sine_squared)) + 1e-3  # and rounding
    outer = 0.5 * light.spot_angle
    inner = math.acos(math.cos(outer) + (1.0 - math.cos(outer)) * light.spot_blend)
    dark = angle - wide > outer
    edge = ~dark & (angle + wide > inner)
    sharp = 2.0 * wide > outer - inner
    return dark, edge & sharp, edge & ~sharp


def _spot_edge(source: _Source, points: Single, frames: Single, distance: Single, radius: Single,
               normals: Single) -> Single:
    """Mean share (c,) of a spot's light across a wide lamp, whose points the edge of the cone parts: by those (n, 2).

    Everything is linear in a point (u, v) of the disc: height, and the place in the lamp's own space.
    """
    middle, first, second = frames[:, 2] * distance[:, None], frames[:, 0] * radius[:, None], \
        frames[:, 1] * radius[:, None]
    to_local = source.to_local.T
    local = [multiply(vector, to_local).T for vector in (middle, first, second)]
    heights = [np.sum(vector * normals, axis=1) for vector in (middle, first, second)]
    scale = np.float32(1.0 / math.sqrt(3.0)) if source.stretch < 1.0 + 1e-5 else None  # of an even `to_local`
    got, whole = np.zeros(len(distance), np.float32), np.zeros(len(distance), np.float32)
    for start in range(0, len(points), AT_ONCE):
        u, v = points[start:start + AT_ONCE].T[:, :, None]
        height = np.maximum(heights[0] + u * heights[1] + v * heights[2], 0.0)
        square = np.maximum(distance * distance + (u * u + v * v) * (radius * radius), np.float32(NEAREST ** 2))
        weight = height / square * (distance / square)
        x, y, z = (local[0][k] + u * local[1][k] + v * local[2][k] if k == 2 or scale is None else 0.0
                   for k in range(3))
        length = np.sqrt(square) * scale if scale is not None else np.sqrt(
            np.maximum(x * x + y * y + z * z, np.finfo(np.float32).tiny))
        share = spot_pattern(z / length, source.light.spot_angle, source.light.spot_blend)
        got += np.sum(weight * share, axis=0)
        whole += np.sum(weight, axis=0)
    return np.divide(got, whole, out=np.zeros_like(got), where=whole > 0.0)


def _aim_at_face(source: _Source, places: Single, normals: Single) -> _Aimed:
    """An Area light: points of the part of its face whose grid opens towards the receiver."""
    away = places - source.centre[:, None]
    depth = source.axis[0] * away[0] + source.axis[1] * away[1] + source.axis[2] * away[2]
    tallest = -np.sum(away * normals, axis=0)
    for half in source.half_axes:
        tallest += np.abs(np.sum(normals * half[:, None], axis=0))
    chosen = np.flatnonzero((depth > 0.0) & (tallest > 0.0))
    if not len(chosen) or source.light.area == 0.0:
        return _nothing()
    face = _Face.of(source, np.ascontiguousarray(np.take(away, chosen, axis=1).T), depth[chosen],
                    np.ascontiguousarray(np.take(normals, chosen, axis=1).T))
    directions, weights = face.look_at(source.points)
    if face.narrow:
        value = face.part * face.mean_weight(source.fine if source.light.shape == "ellipse" else source.smooth)
    else:
        value = face.mean_weight(np.float32(FAR_REACH[source.light.shape]) * FAR_POINTS)
        near = np.flatnonzero(np.sum(face.away ** 2, axis=1) < (NEAR * source.extent) ** 2)
        if len(near):
            value[near] = face.exact(near)
    weights = np.where(value > source.least, weights, 0.0)
    return _Aimed(chosen, value, directions, weights)


@dataclass(frozen=True, eq=False)
class _Face:
    """The face of an Area light as c receivers see it.

    away: (c, 3) from its middle to the receivers; depth: (c,) in front of its plane; middle, half: (c, 2) the rectangle
    of the face's own coordinates (-1..1) that can be seen; part: (c,) its share of the face.
    """

    source: _Source
    away: Single
    depth: Single
    normals: Single
    middle: Single
    half: Single
    part: Single
    narrow: bool

    @staticmethod
    def of(source: _Source, away: Single, depth: Single, normals: Single) -> _Face:
        """With a grid only what lies within depth times tan(spread / 2) around a receiver's foot is seen by it."""
        count = len(depth)
        middle, half = np.zeros((count, 2), np.float32), np.ones((count, 2), np.float32)
        opening = 0.5 * max(source.light.spread, LEAST_SPREAD)
        narrow = has_grid(source.light)
        size = np.sqrt(np.sum(source.half_axes.astype(np.float64) ** 2, axis=1))
        if narrow and abs(float(np.sum(source.half_axes[0] * source.half_axes[1]))) < 1e-3 * size[0] * size[1]:
            reach = depth * math.tan(opening)
            for k in range(2):
                foot = np.sum(away * source.half_axes[k], axis=1) / size[k] ** 2
                low, high = (np.clip(foot + side * reach / size[k], -1.0, 1.0) for side in (-1.0, 1.0))
                middle[:, k], half[:, k] = 0.5 * (low + high), 0.5 * (high - low)
        part = half[:, 0] * half[:, 1]
        if source.light.shape == "ellipse" and narrow:
            part = part * (4.0 / math.pi)  # a rectangle about the ellipse; points off the ellipse weigh nothing
        return _Face(source, away, depth, normals, middle, half, part, narrow)

    def look_at(self, points: Single) -> tuple[Single, Single]:
        """Vectors (n, c, 3) to points (n, 2) of the visible rectangle, and cos cos / d^2 (n, c) times the grid's share.

        An ellipse without a grid takes its points of the unit disc as they are.
        """
        place = self.middle + points[:, None, :] * self.half
        first, second = self.source.half_axes
        directions = place[..., :1] * first + place[..., 1:] * second - self.away
        square = _squares(directions)
        weights = _heights(directions, self.normals) / square * (self.depth / square)
        if self.narrow:
            weights *= spread_pattern(self.depth / np.sqrt(square), self.source.light.spread)
            if self.source.light.shape == "ellipse":
                weights *= np.sum(place ** 2, axis=2) <= 1.0
        return directions, weights

    def mean_weight(self, points: Single) -> Single:
        """The mean (c,) of the weights of many points, as `look_at` gives them, in the face's own plane."""
        along, across, (first, second, slant) = _plane_frame(self.source)
        middle_x = self.middle[:, 0] * first + self.middle[:, 1] * slant - _dot(self.away, along)
        middle_y = self.middle[:, 1] * second - _dot(self.away, across)
        level = -self.depth * _dot(self.normals, self.source.axis)
        normal_x, normal_y = _dot(self.normals, along), _dot(self.normals, across)
        flat = 1.0 / (self.depth * np.float32(math.tan(0.5 * max(self.source.light.spread, LEAST_SPREAD))))
        u_x, v_x, v_y = self.half[:, 0] * first, self.half[:, 1] * slant, self.half[:, 1] * second
        total = np.zeros(len(self.depth), np.float32)
        for start in range(0, len(points), AT_ONCE):
            u, v = points[start:start + AT_ONCE].T[:, :, None]
            x, y = middle_x + u * u_x + v * v_x, middle_y + v * v_y
            aside = x * x + y * y
            square = np.maximum(aside + self.depth * self.depth, np.float32(NEAREST ** 2))
            height = np.maximum(normal_x * x + normal_y * y + level, 0.0)
            weight = height / square * (self.depth / square)
            if self.narrow:
                weight *= np.maximum(1.0 - np.sqrt(aside) * flat, 0.0)
                if self.source.light.shape == "ellipse":
                    weight *= (self.middle[:, 0] + u * self.half[:, 0]) ** 2 + (
                        self.middle[:, 1] + v * self.half[:, 1]) ** 2 <= 1.0
            total += np.sum(weight, axis=0)
        return total / len(points)

    def exact(self, near: NDArray[np.int64]) -> Single:
        """Irradiance of the whole face without a grid, over its area, at some receivers: by Lambert's formula."""
        source = self.source
        if source.light.shape == "rectangle":
            outline, area = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]), 4.0
        else:
            turn = 2.0 * math.pi * np.arange(SIDES) / SIDES
            # so much wider that the polygon has the ellipse's area
            wide = math.sqrt(math.pi / (0.5 * SIDES * math.sin(2.0 * math.pi / SIDES)))
            outline, area = wide * np.stack([np.cos(turn), np.sin(turn)], axis=1), math.pi
        axes = source.half_axes.astype(np.float64)
        corners = multiply(outline, axes)[:, None, :] - self.away[near].astype(np.float64)
        upright = np.cross(*axes)
        area *= math.sqrt(float(np.sum(upright ** 2)))
        return (polygon_irradiance(corners, self.normals[near].astype(np.float64)) / area).astype(np.float32)


def _plane_frame(source: _Source) -> tuple[Single, Single, tuple[np.float32, np.float32, np.float32]]:
    """Two unit vectors of an Area's plane, and its half axes in them: (first, 0) and (slant, second)."""
    first, second = source.half_axes
    length = np.sqrt(np.sum(first * first))
    along = first / length
    across = np.cross(source.axis, along).astype(np.float32)
    return along, across, (length, np.sum(second * across), np.sum(second * along))


def _dot(vectors: Single, direction: Single) -> Single:
    """Products (c,) of vectors (c, 3) with one direction."""
    return vectors[:, 0] * direction[0] + vectors[:, 1] * direction[1] + vectors[:, 2] * direction[2]


def _nothing() -> _Aimed:
    return _Aimed(np.zeros(0, np.int64), np.zeros(0, np.float32), np.zeros((1, 0, 3), np.float32),
                  np.zeros((1, 0), np.float32))


def _length(vectors: Single) -> Single:
    """Lengths (n,) of vectors (3, n)."""
    return np.sqrt(vectors[0] * vectors[0] + vectors[1] * vectors[1] + vectors[2] * vectors[2])


def _heights(directions: Single, normals: Single) -> Single:
    """Clamped heights (n, c) of directions (n, c, 3) above the planes of normals (c, 3)."""
    return np.maximum(sum(directions[..., k] * normals[:, k] for k in range(3)), 0.0)


def _squares(directions: Single) -> Single:
    """Squared lengths (n, c) of directions (n, c, 3); held at those of NEAREST."""
    square = directions[..., 0] ** 2 + directions[..., 1] ** 2 + directions[..., 2] ** 2
    return np.maximum(square, np.float32(NEAREST ** 2))
