# SPDX-License-Identifier: GPL-3.0-or-later
"""Sparse sampling of a cubemap's texels (Huang & Ramamoorthi 2010) is left out by itself where it would be slower.

With rays it is slower nearly everywhere (docs/sparse_precomputation.md); a bake measures what an element costs here,
an analysis, which traces none, takes what was measured there.
"""

from __future__ import annotations

from ..reporting.wording import duration
from ..scene.needs import LeftOut, Needs
from ..tracing.tracer import Tracer
from ..transport.elements import VisibilityElements
from ..transport.receiver_set import ReceiverSet
from ..transport.sparse_plan import element_seconds, plan
from .distant_basis import DistantBasis

SPARSE = "sparse sampling of the cubemap's texels"
# Seconds of a ray in the order in which sparse sampling asks for it, on two cores: 0.175 to 0.232 us were measured.
TYPICAL_SECONDS = 2e-7
RUNS = 3


def sparse_left_out(receivers: int, columns: int, seconds: float = TYPICAL_SECONDS) -> LeftOut:
    """Why sparse sampling is not done for so many receivers and columns, where an element takes so many seconds.

    Even where rays are so slow that it would be faster it is done only where it is asked for: it gains a part of one
    stage, and costs its error.
    """
    found = plan(receivers, columns, seconds)
    asked = "it is done only where it is asked for: " if found.pays else ""
    return LeftOut(SPARSE, f"{asked}tracing all of them takes about {duration(found.all_seconds)}, tracing some and "
                   f"interpolating the others {duration(found.sparse_seconds)}", "the error of interpolation")


def measured_sparse(tracer: Tracer, receivers: ReceiverSet, basis: DistantBasis, seed: int) -> LeftOut:
    """The same by the measured cost of an element, the least of some times some thousand rays: machines are shared."""
    elements = VisibilityElements(tracer, receivers, basis.cubemap)
    seconds = min(element_seconds(elements, seed + run) for run in range(RUNS))
    return sparse_left_out(len(receivers), basis.columns, seconds)


def note_sparse(needs: Needs, found: LeftOut | None) -> None:
    """Put it among what is left out, in place of an earlier line; None: nothing is left out, after all."""
    needs.left_out[:] = [item for item in needs.left_out if item.what != SPARSE]
    if found is not None:
        needs.left_out.append(found)
