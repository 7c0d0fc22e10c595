# SPDX-License-Identifier: GPL-3.0-or-later
"""The report's words: names and explanations for someone who has never heard of radiance transfer, and its numbers."""

from __future__ import annotations

from typing import Any

# Stage -> (name on the page, what happens in it). A stage that is not listed shows under its own name.
STAGES = {
    "prepare": ("Prepare", "sorts the scene's triangles so that rays find what they hit quickly"),
    "gather": ("Look for bounces", "rays from every point find the surfaces that send light back to it"),
    "direct": ("Shadows", "rays from every point find out which parts of the sky it can see"),
    "interreflection": ("Bounce light", "light is passed from surface to surface until too little is left to matter"),
    "glossy": ("Highlights", "the same rays tell what shiny surfaces reflect towards each direction of view"),
    "subsurface": ("Light through bodies", "light that enters a translucent surface is followed to where it leaves"),
    "local": ("Light of lamps", "for each light of the cloud: what bounces from surface to surface; alike ones merge"),
    "encode": ("Compress", "points that react to light alike are put into clusters that share their data"),
    "errors": ("Measure the error", "independent light paths at random points check the result; it changes nothing"),
}

# Error -> (name on the page, what it is, what makes it smaller).
ERRORS = {
    "total": ("All together", "what the preview shows, against a full simulation of the scene's light", ""),
    "sampling": ("Ray sampling", "a limited number of rays stands for all directions",
                 "more directions and gather_directions, or a higher preset"),
    "basis": ("Soft lighting", "the light is stored as a smooth sky of limited detail, so small bright lights such as "
              "a sun in the HDRI cast softer shadows than they should", "a higher order"),
    "compression": ("Compression", "points in one cluster share their data", "more clusters or vectors"),
}

# The same for the bounced light of lamps.
LOCAL_ERRORS = {
    "total": ("All together", "the light of a lamp in the open, after at least one bounce, against a "
              "full simulation", ""),
    "sampling": ("Ray sampling", "a limited number of rays, and the mesh's vertices, carry light from surface to "
                 "surface", "more gather_directions, or a smaller spacing"),
    "basis": ("Columns of lamps", "the light that a lamp gives to surfaces is stored by patches of them and their "
              "leading ways to differ, or put together from a cloud of lights", "more surface_columns and "
              "surface_patches; with a cloud, more cloud_lights or a lower merge_response"),
    "compression": ("Compression", "points in one cluster share their data", "more clusters or vectors"),
}

# The same for highlights.
HIGHLIGHT_ERRORS = {
    "total": ("All together", "the highlights that the preview shows, against a full simulation with the materials' "
              "own reflection", ""),
    "sampling": ("Ray sampling", "a limited number of rays stands for all directions",
                 "more directions and gather_directions, or a higher preset"),
    "rows": ("Soft view", "how a highlight changes with the direction of view is stored as a smooth function",
             "more glossy_rows"),
    "basis": ("Soft lighting", "the light is stored as a smooth sky of limited detail, so reflections are blurred, and "
              "those of small bright lights most", "a higher order"),
    "bounces": ("Reflections in reflections", "shiny surfaces show each other once; in what they show, further "
                "reflections are spread evenly", ""),
    "compression": ("Compression", "points in one cluster share their data", "more clusters or vectors"),
}

# The same for highlights under lamps.
LOCAL_HIGHLIGHT_ERRORS = {
    "total": ("All together", "what highlights show of the surfaces that a lamp shines on, against a full simulation "
              "with the materials' own reflection", ""),
    "baked": ("As baked", "a limited number of rays, the columns that lamps are put together from, and the smooth "
              "functions of the view", "more gather_directions, surface_columns (cloud_lights) or glossy_rows"),
    "bounces": ("Reflections in reflections", "in what highlights show, further reflections are spread evenly", ""),
    "compression": ("Compression", "points in one cluster share their data", "more clusters or vectors"),
    "direct": ("The lamp itself", "its own highlight, which no bake holds, is shown with the same smooth functions of "
               "the view; not part of all together", "more glossy_rows"),
}

# Upper end of each zone on the error plot and its name; a relative RMS of 1 % is about 2.5 of 255 grey levels at most.
ZONES = ((0.01, "hard to see"), (0.05, "slight"), (1.0, "visible"))

GLOSSARY = (
    ("Point", "a place on a surface for which the bake stores how it reacts to light from every direction, usually a"
     " vertex of the mesh. Between points, values are blended."),
    ("Bake", "the slow step that happens once. Afterwards the scene's HDRI and suns can be turned, dimmed or "
     "exchanged, and shadows and bounced light follow at once."),
    ("Ray", "a straight line shot from a point to find out what it sees."),
    ("Relative error (RMS)", "the typical difference from the right brightness, divided by the typical brightness. "
     "1 % is hard to see, 5 % is visible when two pictures are put side by side."),
    ("95 % interval", "the error is itself measured at random points, so it is known only roughly: in 95 of 100 such "
     "measurements the true value lies inside."),
    ("Cluster", "a group of points that react to light alike. Each point is described by its cluster's mean and a few "
     "weights for the cluster's vectors, which takes much less memory than storing everything for every point."),
    ("Overdraw", "how often the mesh's triangles would be drawn if each cluster were drawn on its own; 1 is best."),
    ("Supercluster", "several clusters that an old graphics card could hold at once and draw as one."),
    ("Light cloud", "lights spread evenly over the space where lamps will move; the light that each of them sends"
     " around by bounces is baked, and a lamp takes its own from those nearest to it."),
    ("Highlight", "the light that a surface reflects like a blurred mirror: it changes with the direction of view."),
)


def count(value: int | float | None) -> str:
    """A whole number with thin separators, shortened from a million up."""
    if value is None:
        return "unknown"
    for limit, unit in ((1e9, "billion"), (1e6, "million")):
        if value >= limit:
            return f"{value / limit:.1f} {unit}"
    return f"{value:,.0f}".replace(",", "\u202f")


def duration(seconds: float | None) -> str:
    """Seconds as people say them: 0.24 s, 12 s, 3 min 20 s, 2 h 5 min."""
    if seconds is None:
        return "unknown"
    if seconds < 9.95:
        return f"{seconds:.2g} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def memory(size: int | float | None) -> str:
    """Bytes in the unit that fits."""
    if size is None:
        return "unknown"
    for limit, unit in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if size >= limit:
            return f"{size / limit:.2g} {unit}" if size < 10 * limit else f"{size / limit:.0f} {unit}"
    return f"{size:.0f} bytes"


def number(value: Any) -> str:
    """A value of a table as short as it stays exact enough."""
    if value is None:
        return "unknown"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int) or (isinstance(value, float) and value.is_integer() and abs(value) < 1e6):
        return f"{int(value):,}".replace(",", "\u202f")
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def plural(value: int, one: str, many: str) -> str:
    """"1 object", "3 objects"."""
    return f"{count(value)} {one if value == 1 else many}"
