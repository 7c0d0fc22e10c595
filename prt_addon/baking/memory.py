# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether a bake fits in this machine's memory: said before the first ray, with what to do about it."""

from __future__ import annotations

from ..errors import BadScene
from ..reporting.stages import available_bytes
from ..reporting.wording import memory
from .plan import Plan
from .settings import BakeSettings


def memory_warning(plan: Plan, settings: BakeSettings) -> str | None:
    """A line where the bake may not fit in memory; None where it does, or nobody knows how much there is.

    Raises BadScene where it can't fit, however many of the cloud's lights merge: better than hours of work that end
    with the process killed.
    """
    free = available_bytes()
    if free is None or plan.peak_bytes <= free:
        return None
    remedy = memory_remedy(plan, settings)
    if plan.least_bytes > free:
        raise BadScene("Bake", f"it needs at least about {memory(plan.least_bytes)} of memory, and {memory(free)} are "
                       "free", remedy)
    return f"it may need {memory(plan.peak_bytes)} of memory, and {memory(free)} are free. If it fails: {remedy}"


def memory_remedy(plan: Plan, settings: BakeSettings) -> str:
    """What takes the most of it, as advice."""
    shiny = any(part.kernel is not None for part in plan.surfaces.parts)
    ways = []
    if settings.local_light:
        if settings.lamp_basis == "surfaces":
            ways += ["fewer surface_columns and surface_patches", "fewer lights to learn from (cloud_lights)"]
        else:
            ways += ["fewer lights (cloud_lights)", "more merging (merge_response)"]
        if settings.lamp_basis == "cloud" and settings.cloud_emission > 1:
            ways.append("cloud_emission=1, if spots may bounce like points")
    if shiny:
        ways.append("fewer functions of highlights (glossy_rows)")
    if settings.distant_light:
        if settings.distant_basis == "cubemap":
            ways += ["fewer texels (cubemap_size)", "a smaller memory_budget"]
        else:
            ways.append("a lower order")
        ways.append("fewer gather_directions")
    return f"Choose {', '.join(ways)}, or fewer objects"
