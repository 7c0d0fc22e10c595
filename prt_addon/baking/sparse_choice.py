# SPDX-License-Identifier: GPL-3.0-or-later
"""Sparse sampling of a cubemap's texels (Huang & Ramamoorthi 2010) is left out by itself where it would be slower.

With rays it is slower nearly everywhere (docs/sparse_precomputation.md); a bake measures what an element costs here,
an analysis, which traces none, takes what was measured there.
"""

from __future__ import annotations

from ..reporting.wording import duration
from ..scene.needs import LeftOut, Needs
from ..transport.sparse_plan import HARDER_RAYS, SparsePlan, plan

SPARSE, SAVED = "sparse sampling of the cubemap's texels", "the error of interpolation"
# Seconds of a ray in order, on two cores: 0.04 to 0.15 us were measured. An element is a few of them.
TYPICAL_SECONDS = 1e-7


def sparse_left_out(receivers: int, columns: int, seconds: float = TYPICAL_SECONDS) -> LeftOut:
    """Why sparse sampling is not done for so many receivers and columns, where an element takes so many seconds.

    Even where rays are so slow that it would be faster it is done only where it is asked for: it gains a part of one
    stage, and costs its error.
    """
    return sparse_line(plan(receivers, columns, seconds, harder=HARDER_RAYS), "it is done only where it is asked for")


def sparse_line(found: SparsePlan, against: str) -> LeftOut:
    """The line for a plan; against: what speaks against sparse sampling where it would be faster."""
    asked = f"{against}: " if found.sparse_seconds < found.all_seconds else ""
    return LeftOut(SPARSE, f"{asked}tracing all of them takes about {duration(found.all_seconds)}, tracing some and "
                   f"interpolating the others {duration(found.sparse_seconds)}", SAVED)


def note_sparse(needs: Needs, found: LeftOut | None) -> None:
    """Put it among what is left out, in place of an earlier line; None: nothing is left out, after all."""
    needs.left_out[:] = [item for item in needs.left_out if item.what != SPARSE]
    if found is not None:
        needs.left_out.append(found)
