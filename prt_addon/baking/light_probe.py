# SPDX-License-Identifier: GPL-3.0-or-later
"""How much of a scene's shadows each basis of distant light would lose, measured at a few of its receivers.

A light's energy in its bands alone says nothing of shadows: what a basis drops meets visibility, and how much of that
lies in the same details depends on the scene (an open plane loses nothing under any sky). So some random receivers are
traced over the whole sphere, a million rays, and lit twice: by the light itself and by what each basis holds of
it. The light is the one of the error budget: an environment, its brightest pixels sampled one by one, and suns.

The error is direct shadowed irradiance's: relative RMS over receivers and channels. Bounced light, smoother, comes on
top in a bake, so that its own error of the basis is as large or somewhat smaller.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..basis.cubemap import cubemap_directions, cubemap_solid_angles, sample_directions, texel_of
from ..basis.directions import disc_directions, tangent_frames
from ..basis.point_sets import fibonacci_square
from ..basis.spherical_harmonics import evaluate
from ..lighting.analytic import sun
from ..lighting.bright_light import is_sharp
from ..lighting.cubemap_light import shared, sun_texels
from ..lighting.environment import direction_of_pixel, pixel_solid_angles
from ..lighting.reference_light import ReferenceLight
from ..linear_algebra import multiply
from ..scene.scene_mesh import SceneMesh
from ..tracing.tracer import Tracer
from ..transport.cubemap_transfer import cubemap_transfer
from ..transport.direct import cosine_visibility
from ..transport.receiver_set import ReceiverSet
from .error_budget import choose_receivers

Double = NDArray[np.float64]

# Receivers, and the cubemap that they see: its transfer holds that of every basis below.
RECEIVERS, FINE = 384, 32
# Orders and cubemaps that are tried. Orders above those that are baked tell how fast what is left dies out.
ORDERS, CUBEMAPS = 14, (8, 16, 32)
# Pixels of the environment that are sampled one by one, samples along each of their sides, and samples of a sun's disc.
BRIGHTEST, SAMPLES, SUN_SAMPLES = 48, 4, 16


@dataclass(frozen=True)
class LightProbe:
    """Relative RMS error of shadowed irradiance: harmonics, (ORDERS,) by order from 1; cubemaps, by texels along an
    edge; receivers, rays: what it was found with. All errors are 0 where there is no light."""

    harmonics: tuple[float, ...]
    cubemaps: dict[int, float]
    receivers: int
    rays: int


@dataclass(frozen=True)
class _Light:
    """A light in parts: even, (6 FINE^2, 3) radiance of the environment without its brightest pixels; small sources:
    directions (n, 3), radiance times solid angle of each (n, 3), of pixels; and the suns' own."""

    even: Double
    directions: Double
    flux: Double
    suns: ReferenceLight


def probe_light(scene: SceneMesh, tracer: Tracer, light: ReferenceLight, shadow_rays: bool = True, seed: int = 1,
                ) -> LightProbe:
    """Errors of all bases under `light`, at random receivers of the scene's targets. Independent of threads."""
    keys = np.concatenate([np.arange(o.points.start, o.points.stop) for o in scene.objects if o.is_target])
    keys = choose_receivers(keys[~scene.loose[keys]], RECEIVERS, seed)
    before, parts = tracer.rays, _parts(light)
    receivers = ReceiverSet.of_keys(scene, tracer, keys)
    steps = cubemap_transfer(tracer, receivers, FINE, 1, shadow_rays)
    while True:
        try:
            next(steps)
        except StopIteration as end:
            transfer = end.value.T.astype(np.float64)  # (receivers, 6 FINE^2)
            break
    traced = tracer if shadow_rays else None
    truth = multiply(transfer, parts.even) + _seen(traced, tracer, receivers, parts)
    harmonics = _projected(transfer, parts)
    power = float(np.sum(truth ** 2))

    def error(found: Double) -> float:
        return math.sqrt(float(np.sum((found - truth) ** 2)) / power) if power > 0.0 else 0.0

    cubemaps = {r: error(multiply(_coarser(transfer, r), _texels(parts, r))) for r in CUBEMAPS}
    return LightProbe(tuple(error(found) for found in harmonics), cubemaps, len(keys), tracer.rays - before)


def _parts(light: ReferenceLight) -> _Light:
    """The light's even part and its small sources."""
    light = light.coarse()
    height, width = light.image.shape[:2]
    solid_angle = np.repeat(pixel_solid_angles(height, width), width)
    image = light.image.reshape(-1, 3).astype(np.float64)
    brightest = np.argsort(-image.sum(axis=1) * solid_angle, kind="stable")[:BRIGHTEST]
    flux = image[brightest] * solid_angle[brightest, None] / SAMPLES ** 2
    steps = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    row, column = brightest // width, brightest % width
    directions = direction_of_pixel(row[:, None, None] + steps[:, None], column[:, None, None] + steps[None, :], height,
                                    width).reshape(-1, 3)
    directions = np.sum(directions[:, None, :] * light.rotation, axis=2)
    rest = light.image.copy()
    rest.reshape(-1, 3)[brightest] = 0.0
    even = replace(light, image=rest)
    samples = even.radiance(sample_directions(FINE, 2).reshape(-1, 3)).reshape(-1, 4, 3)
    return _Light(samples.mean(axis=1), directions, np.repeat(flux, SAMPLES ** 2, axis=0), light)


def _seen(traced: Tracer | None, tracer: Tracer, receivers: ReceiverSet, parts: _Light) -> Double:
    """Irradiance over pi (r, 3) of pixels and suns, by rays to each."""
    directions, flux = [parts.directions], [parts.flux]
    suns = parts.suns
    for direction, irradiance, angle in zip(suns.sun_directions, suns.sun_irradiance, suns.sun_angles, strict=True):
        count = SUN_SAMPLES if angle > 0.0 else 1
        numbers = (fibonacci_square(count) + 1.0) * 0.5
        found, factor = disc_directions(tangent_frames(np.asarray(direction)[None])[0], float(angle), numbers)
        directions.append(found)
        flux.append(np.repeat(irradiance[None] * (factor / count), count, axis=0))
    whole = slice(0, len(receivers))
    _, visible, rays = cosine_visibility(traced, receivers, whole,
                                         np.ascontiguousarray(np.concatenate(directions), np.float32))
    tracer.rays += rays
    return multiply(visible.T.astype(np.float64), np.concatenate(flux)) / np.pi


def _projected(transfer: Double, parts: _Light) -> list[Double]:
    """(r, 3) of what harmonics of order 1, 2, ... hold of the light."""
    at = evaluate(ORDERS, cubemap_directions(FINE))
    coefficients = multiply(at.T, parts.even * cubemap_solid_angles(FINE)[:, None])
    coefficients = coefficients + multiply(evaluate(ORDERS, parts.directions).T, parts.flux)
    suns = parts.suns
    for direction, irradiance, angle in zip(suns.sun_directions, suns.sun_irradiance, suns.sun_angles, strict=True):
        coefficients = coefficients + sun(direction, irradiance, float(angle), ORDERS)
    functions = multiply(transfer, at)
    found, total = [], np.zeros((len(transfer), 3))
    for band in range(ORDERS):
        mine = slice(band * band, (band + 1) ** 2)
        total = total + multiply(functions[:, mine], coefficients[mine])
        found.append(total)
    return found


def _coarser(transfer: Double, r: int) -> Double:
    """Transfer (receivers, 6 r r) of that of FINE texels: a texel's is the sum of its parts'."""
    part = FINE // r
    return transfer.reshape(-1, 6, r, part, r, part).sum(axis=(3, 5)).reshape(len(transfer), -1)


def _texels(parts: _Light, r: int) -> Double:
    """Mean radiance (6 r r, 3) of texels."""
    part, solid_angles = FINE // r, cubemap_solid_angles(r)
    flux = (parts.even * cubemap_solid_angles(FINE)[:, None]).reshape(6, r, part, r, part, 3).sum(axis=(2, 4))
    flux = flux.reshape(-1, 3)
    if is_sharp(parts.suns.image):
        flux = flux + shared(parts.directions, parts.flux, r)  # as a bake's light does
    else:
        np.add.at(flux, texel_of(parts.directions, r), parts.flux)
    total, suns = flux / solid_angles[:, None], parts.suns
    for direction, irradiance, angle in zip(suns.sun_directions, suns.sun_irradiance, suns.sun_angles, strict=True):
        total = total + sun_texels(direction, irradiance, float(angle), r)
    return total
