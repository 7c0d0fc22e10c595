# SPDX-License-Identifier: GPL-3.0-or-later
"""How far a drawn picture is from a rendered one: numbers, and their difference in false colours.

All pictures are scene-linear, row 0 on top. The rendered one comes as two halves with independent noise: A - truth and
B - truth do not correlate, so the mean of (P - A)(P - B) is the squared error of P without the noise in it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .svg_plots import percent

SCHEMA = 1
# Of 1 / depth: where its second difference is larger, one surface ends in front of another.
DEPTH_JUMP = 0.02
DARK = 0.01  # relative errors of single pixels count against at least this share of the mean brightness
SHARES = (0.01, 0.05)
LEAST_PIXELS = 16
RANGES = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
# Darker than the truth to brighter: deep blue, light blue, near white, orange, dark red. Even in lightness both ways.
STOPS = ((0.13, 0.25, 0.58), (0.45, 0.66, 0.87), (0.96, 0.96, 0.95), (0.96, 0.62, 0.38), (0.66, 0.07, 0.13))


def inner_pixels(objects: NDArray[np.integer], depth: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Pixels (h, w) whose whole neighbourhood shows one surface of one object: what is mixed at edges is left out.

    objects: (h, w) number of the object that a pixel's centre shows, 0 for none that counts; depth: (h, w), along the
    view, 0 for nothing. 1 / depth is linear over a plane, so only a jump has a large second difference.
    """
    inner = objects > 0
    near = np.divide(1.0, depth, out=np.zeros(depth.shape), where=depth > 0)
    for axis in (0, 1):
        for shift in (-1, 1):
            inner &= _shifted(objects, shift, axis) == objects
            inner &= _shifted(_shifted(objects, shift, axis), 1, 1 - axis) == objects
            inner &= _shifted(_shifted(objects, shift, axis), -1, 1 - axis) == objects
        bend = np.abs(_shifted(near, 1, axis) + _shifted(near, -1, axis) - 2.0 * near) > DEPTH_JUMP * near
        inner &= ~(bend | _shifted(bend, 1, axis) | _shifted(bend, -1, axis))
    return inner


def _shifted(values: NDArray, shift: int, axis: int) -> NDArray:
    """Values moved by one pixel; the border repeats itself."""
    places = np.clip(np.arange(values.shape[axis]) - shift, 0, values.shape[axis] - 1)
    return np.take(values, places, axis)


def compare(drawn: NDArray[np.floating], halves: tuple[NDArray, NDArray], objects: NDArray[np.integer],
            inner: NDArray[np.bool_], names: list[str]) -> dict[str, Any]:
    """Numbers of a comparison as JSON-able values; None for what too few pixels can't say.

    drawn, halves: (h, w, 3); objects: (h, w), names[number - 1]; inner: (h, w), the pixels that count.
    relative_rms: without the noise of the render; bias: of the mean radiance, positive where the drawing is brighter;
    within: shares of pixels, noise included; noise: relative RMS of the render itself; noise_within: the shares of
    pixels that another render of the same length would have.
    """
    found = _numbers(drawn[inner], halves[0][inner], halves[1][inner])
    parts = [{"name": name, **_numbers(*(values[inner & (objects == number)] for values in (drawn, *halves)))}
             for number, name in enumerate(names, 1)]
    return {"schema": SCHEMA, "pixels": int(inner.size), **found, "objects": parts}


def _numbers(drawn: NDArray, first: NDArray, second: NDArray) -> dict[str, Any]:
    """The numbers of some pixels (n, 3)."""
    drawn, first, second = (values.astype(np.float64) for values in (drawn, first, second))
    mean = 0.5 * (first + second)
    energy = float(np.sum(first * second))
    names = ("relative_rms", "bias", "noise")
    if len(drawn) < LEAST_PIXELS or energy <= 0.0:
        return {"compared": len(drawn), **dict.fromkeys(names), "within": {}, "noise_within": {}}
    squared = float(np.sum((drawn - first) * (drawn - second)))
    noise = 0.5 * (first - second)  # of the mean of both
    errors = relative_errors(drawn, mean)
    # Two renders of this length differ by sqrt(2) times the noise of each.
    own = relative_errors(mean + np.sqrt(2.0) * noise, mean)
    return {
        "compared": len(drawn),
        "relative_rms": float(np.sqrt(max(squared, 0.0) / energy)),
        "bias": float(np.sum(drawn - mean) / np.sum(mean)),
        "noise": float(np.sqrt(np.sum(noise ** 2) / energy)),
        "within": {f"{share:g}": float(np.mean(errors <= share)) for share in SHARES},
        "noise_within": {f"{share:g}": float(np.mean(own <= share)) for share in SHARES},
    }


def relative_errors(drawn: NDArray[np.floating], truth: NDArray[np.floating]) -> NDArray[np.float64]:
    """Error of each pixel (n,) of colours (n, 3), against its own brightness or, where it is darker, DARK of all."""
    brightness = np.sqrt(np.sum(truth ** 2, axis=-1))
    return np.sqrt(np.sum((drawn - truth) ** 2, axis=-1)) / np.maximum(brightness, DARK * brightness.mean() + 1e-30)


def false_colours(drawn: NDArray[np.floating], truth: NDArray[np.floating], inner: NDArray[np.bool_],
                  ) -> tuple[NDArray[np.uint8], float]:
    """The signed relative difference as colours (h, w, 3) for a screen, and the difference that the ends stand for.

    The range is the smallest of RANGES that holds 95 % of the pixels. What does not count is dark grey.
    """
    picture = np.full((*inner.shape, 3), 40, np.uint8)
    if not inner.any():
        return picture, RANGES[0]
    light, ours = truth[inner].sum(axis=-1, dtype=np.float64), drawn[inner].sum(axis=-1, dtype=np.float64)
    difference = (ours - light) / np.maximum(light, DARK * light.mean() + 1e-30)
    most = float(np.quantile(np.abs(difference), 0.95))
    limit = next((value for value in RANGES if value >= most), RANGES[-1])
    picture[inner] = difference_colours(difference / limit)
    return picture, limit


def difference_colours(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Colours (n, 3) of values (n,) in -1..1, beyond which they stay as at the ends."""
    places = np.linspace(-1.0, 1.0, len(STOPS))
    channels = [np.interp(values, places, [stop[k] for stop in STOPS]) for k in range(3)]
    return np.rint(255.0 * np.stack(channels, axis=-1)).astype(np.uint8)


def comparison_lines(result: dict[str, Any]) -> list[str]:
    """A comparison in a few short lines for a person."""
    if result["relative_rms"] is None:
        return [f"Only {result['compared']} pixels show baked surfaces: too few to compare"]
    within, own = (", ".join(f"{100.0 * share:.0f} % within {100.0 * float(limit):g} %"
                             for limit, share in result[key].items()) for key in ("within", "noise_within"))
    bias = result["bias"]
    tone = "as bright on average" if abs(bias) < 5e-5 else \
        f"{percent(abs(bias))} {'brighter' if bias > 0 else 'darker'} on average"
    return [f"Difference {percent(result['relative_rms'])} (relative RMS), {tone}",
            f"Of the pixels {within}",
            f"Noise of Cycles {percent(result['noise'])}; a second render of it: {own}",
            f"{result['compared']:,} of {result['pixels']:,} pixels compared".replace(",", "\u202f"),
            f"Cycles {result['cycles']['seconds']:.1f} s with {result['cycles']['samples']} samples, "
            f"preview {result['preview_seconds']:.2f} s"]
