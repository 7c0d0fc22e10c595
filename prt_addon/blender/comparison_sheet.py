# SPDX-License-Identifier: GPL-3.0-or-later
"""A comparison as one picture: what was drawn, what was rendered, and their difference with its scale."""

from __future__ import annotations

import numpy as np

from ..reporting.comparison import difference_colours
from .pictures import Picture, lettered, text_width

LEAST_WIDTH = 480  # of each of the three pictures: smaller ones are enlarged by a whole factor
GAP, PAPER, INK = 12, 28, (0.9, 0.9, 0.9)
TEXT, BAR_HEIGHT, BAR_STEPS = 17, 16, 256
LINE = 26
TICKS = (-1.0, -0.5, 0.0, 0.5, 1.0)


def comparison_sheet(drawn: Picture, rendered: Picture, difference: Picture, limit: float,
                     captions: tuple[str, str, str]) -> Picture:
    """The three pictures (h, w, 3) side by side, captions under them; under the last its scale, -limit to limit."""
    factor = max(1, -(-LEAST_WIDTH // drawn.shape[1]))
    pictures = [picture.repeat(factor, axis=0).repeat(factor, axis=1) for picture in (drawn, rendered, difference)]
    height, width, _ = pictures[0].shape
    sheet = np.full((height + 2 * GAP + 3 * LINE, 3 * width + 4 * GAP, 3), PAPER, np.uint8)
    texts, caption = [], GAP + height + LINE - 4
    for number, (picture, text) in enumerate(zip(pictures, captions, strict=True)):
        left = GAP + number * (width + GAP)
        sheet[GAP:GAP + height, left:left + width] = picture
        texts.append((text, left, caption, TEXT))
    bar_top = caption + 10
    scale = difference_colours(np.linspace(-1.0, 1.0, width))
    sheet[bar_top:bar_top + BAR_HEIGHT, left:left + width] = scale
    for tick in TICKS:
        text = f"{100.0 * tick * limit:+g} %" if tick else "0"
        across = text_width(text, TEXT)
        place = left + round(0.5 * (tick + 1.0) * (width - 1))
        sheet[bar_top + BAR_HEIGHT:bar_top + BAR_HEIGHT + 4, min(place, left + width - 2):place + 2] = 200
        texts.append((text, int(np.clip(place - across // 2, left, left + width - across)),
                      bar_top + BAR_HEIGHT + 21, TEXT))
    return lettered(sheet, texts, INK)
