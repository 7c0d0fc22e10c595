# SPDX-License-Identifier: GPL-3.0-or-later
"""What this scene needs, from its geometry and materials alone: the rest is left out, and the report says so."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .scene_mesh import SceneMesh

# Two channels differ if some albedo does by more than half an 8-bit step.
GREY_TOLERANCE = 0.5 / 255.0
# A surface darker than this returns less light than the smallest step of an 8-bit display.
BLACK = 1e-3
# Slack of the convexity test, as a fraction of the bounding diagonal: above rounding, far below what casts a shadow.
CONVEX_TOLERANCE = 1e-7


@dataclass(frozen=True)
class LeftOut:
    """Something that was not done: what, why, and what it saved, each for a person to read."""

    what: str
    why: str
    saved: str


@dataclass
class Needs:
    """shadow_rays, bounces: whether they can change anything; channels: 1, or 3 where bounced light takes on colour;
    order: of the lighting basis; left_out: what was decided against; hints: what the artist might change."""

    shadow_rays: bool
    bounces: bool
    channels: int
    order: int
    left_out: list[LeftOut] = field(default_factory=list)
    hints: list[str] = field(default_factory=list)


def decide(scene: SceneMesh, order: int, bounces: int, planned_rays: tuple[int, int],
           light_order: int | None = None, fit_order_to_light: bool = False, coloured_surfaces: bool = False) -> Needs:
    """What a bake of `scene` at `order` needs.

    bounces: asked for (-1 as many as it takes). planned_rays: of the shadow and the gather stage, for what is saved.
    light_order: highest order in which the scene's light carries energy, if known. coloured_surfaces: highlights or
    subsurface light differ between channels.
    """
    needs = Needs(True, bounces != 0, 1, order)
    shadow, gather = planned_rays
    _need_shadows(scene, needs, shadow, gather)
    if needs.bounces:
        _need_bounces(scene, needs, gather)
    if coloured_surfaces or (needs.bounces and _coloured(scene)):
        needs.channels = 3
    else:
        why = "every albedo that bounces light is grey" if needs.bounces else "no light is bounced to take on colour"
        needs.left_out.append(LeftOut("two of three colour channels", why, "2/3 of bases, bounce and encoding work"))
    if light_order is not None and light_order < order:
        _lower_order(needs, light_order, fit_order_to_light)
    return needs


def _need_shadows(scene: SceneMesh, needs: Needs, shadow: int, gather: int) -> None:
    if not is_lone_convex(scene):
        return
    needs.shadow_rays = False
    saved = shadow + (gather if needs.bounces else 0)
    what = "shadow rays and bounces" if needs.bounces else "shadow rays"
    needs.bounces = False
    needs.left_out.append(LeftOut(what, "a lone convex (or flat) mesh can't see itself: its transfer is known exactly",
                                  f"{saved:,} rays"))


def _need_bounces(scene: SceneMesh, needs: Needs, gather: int) -> None:
    if float(scene.albedo[~scene.loose].max(initial=0.0)) < BLACK and all(m.is_diffuse for m in scene.materials):
        needs.bounces = False
        needs.left_out.append(LeftOut("bounces", "every surface is black", f"{gather:,} rays"))


def _coloured(scene: SceneMesh) -> bool:
    spread = scene.albedo.max(axis=1) - scene.albedo.min(axis=1)
    return bool(np.any(spread[~scene.loose] > GREY_TOLERANCE))


def _lower_order(needs: Needs, light_order: int, fit: bool) -> None:
    saved = f"{1.0 - (light_order / needs.order) ** 2:.0%} of coefficients"
    if fit:
        needs.left_out.append(LeftOut(f"orders {light_order + 1} to {needs.order}",
                                      "the scene's light carries no energy there", saved))
        needs.order = light_order
    else:
        needs.hints.append(f"the present light needs order {light_order} only; fit_order_to_light=true would save"
                           f" {saved}, but a later light with more detail would need a new bake")


def is_lone_convex(scene: SceneMesh) -> bool:
    """Whether all triangles together are flat, or one closed surface that is convex everywhere.

    A closed connected surface that is convex at every edge is convex as a whole (Tietze-Nakajima), so only neighbours
    are compared. Split points (equal positions) count as one.
    """
    points, triangles = scene.shape
    if not len(triangles) or _surely_not_convex(points, triangles):
        return False
    positions, place = np.unique(points, axis=0, return_inverse=True)
    triangles = place.reshape(-1)[triangles]
    corners = positions[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.sqrt(np.sum(normal ** 2, axis=1, keepdims=True)), np.finfo(np.float64).tiny)
    used = np.unique(triangles)
    extent = float(np.ptp(positions[used], axis=0).max())
    slack = CONVEX_TOLERANCE * extent
    height = np.sum((positions[used] - corners[0, 0]) * normal[0], axis=1)
    if np.abs(height).max() <= slack and float(np.min(np.sum(normal * normal[0], axis=1))) > 0.0:
        return True
    return _closed_convex(positions, triangles, normal, slack)


def _surely_not_convex(points: NDArray[np.float64], triangles: NDArray[np.int32]) -> bool:
    """A cheap look at evenly spaced points and triangles that spares nearly every scene the full test."""
    used = np.unique(triangles)
    corners = points[triangles[:: max(1, len(triangles) // 2048)]]
    points = points[used[:: max(1, len(used) // 64)]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.sqrt(np.sum(normal ** 2, axis=1, keepdims=True)), np.finfo(np.float64).tiny)
    height = sum(points[:, None, axis] * normal[None, :, axis] for axis in range(3))
    height = height - np.sum(corners[:, 0] * normal, axis=1)
    return bool(height.max() > 1e-5 * float(np.ptp(points, axis=0).max()))


def _closed_convex(positions: NDArray[np.float64], triangles: NDArray[np.int64], normal: NDArray[np.float64],
                   slack: float) -> bool:
    """Whether each edge has exactly two triangles, each below the other's plane, and all are connected and one ball."""
    start, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    apex = np.roll(triangles, -2, axis=1).ravel()
    face = np.repeat(np.arange(len(triangles)), 3)
    forward, backward = start * len(positions) + end, end * len(positions) + start
    order = np.argsort(forward, kind="stable")
    place = np.searchsorted(forward[order], backward)
    place = np.minimum(place, len(order) - 1)
    if len(np.unique(forward)) != len(forward) or not np.array_equal(forward[order][place], backward):
        return False
    twin = order[place]
    height = np.sum((positions[apex[twin]] - positions[start]) * normal[face], axis=1)
    if height.max() > slack:
        return False
    # Euler's formula tells a sphere from a torus or from several bodies: V - E + F = 2 for one ball; a surface that is
    # convex at every edge has no other connected form.
    return len(np.unique(triangles)) - len(forward) // 2 + len(triangles) == 2
