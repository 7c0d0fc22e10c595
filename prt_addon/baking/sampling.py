# SPDX-License-Identifier: GPL-3.0-or-later
"""Which elements of a cubemap's direct light a bake traces: every one, or a part from which the rest is woven
(transport/sparse_sampling.py), with the error that this makes, measured."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..compression.dense_first import encode_dense_first
from ..compression.encoding import Encoding
from ..compression.monitor import Progress
from ..compression.settings import METHODS, EncoderSettings
from ..lighting.reference_light import ReferenceLight, stand_in_light
from ..linear_algebra import multiply
from ..scene.needs import LeftOut
from ..scene.object_mesh import bounding_diagonal
from ..scene.scene_mesh import SceneMesh
from ..transport.receiver_set import ReceiverSet
from ..transport.sparse_plan import HARDER_RAYS, SAMPLED, element_seconds, overhead, plan
from ..transport.sparse_sampling import VERTICES, SparseSettings, SparseTransfer, sparse_transfer
from ..transport.texel_elements import TexelElements
from .distant_basis import DistantBasis, array_budget
from .settings import BakeSettings
from .sparse_choice import SAVED, SPARSE, sparse_line

Single = NDArray[np.float32]

# Dense neighbours that the radius gives to so many receivers in a hundred: where a ground's error is least.
NEIGHBOURS, MOST_OF_THEM = 14, 75
# Texels along an edge below which windows of a few texels say nothing, and all texels together cost little.
SMALLEST = 8
# Bytes an element of a block of sparse receivers: values, factors, what is unknown, and their neighbours' rows.
BLOCK_BYTES = 24
# Receivers of which all elements are traced once more to measure the error, and the relative RMS above which a report
# warns: of light, and that `automatic` takes sparse sampling to have (0.2 to 1.2 % on two models and their grounds).
CHECKED, LIMIT, TYPICAL_ERROR = 128, 0.05, 0.01


@dataclass(frozen=True)
class SampledDirect:
    """transfer (r, columns) of direct light; dense (r,) bool: receivers sampled as dense ones, None where every element
    was traced; facts: for the report's "sampling"; left_out: what was decided against."""

    transfer: Single
    dense: NDArray[np.bool_] | None
    facts: dict[str, Any]
    left_out: LeftOut | None = None

    def kept(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and header of a finished stage, besides the transfer."""
        arrays = {} if self.dense is None else {"dense": self.dense}
        return arrays, {"facts": self.facts, "left_out": None if self.left_out is None else asdict(self.left_out)}

    @staticmethod
    def unpacked(arrays: dict[str, NDArray], header: dict[str, Any]) -> SampledDirect:
        """What `kept` gave, with the transfer."""
        left_out = header.get("left_out")
        return SampledDirect(arrays["transfer"], arrays.get("dense"), header.get("facts", {}),
                             LeftOut(**left_out) if left_out else None)


def sampling_hints(settings: BakeSettings) -> list[str]:
    """What the choice of sampling comes to nothing with."""
    if settings.sampling == "sparse" and not (settings.distant_light and settings.distant_basis == "cubemap"):
        return ["sampling=sparse is for a cubemap's columns: it needs distant_basis=cubemap"]
    return []


def is_sparse(settings: BakeSettings, highlights: bool = False) -> bool:
    """Whether sparse sampling was asked for, and there is something to sample."""
    return (settings.sampling == "sparse" and not highlights and settings.cubemap_size >= SMALLEST
            and settings.distant_light and settings.distant_basis == "cubemap")


def forecast_share(settings: BakeSettings, highlights: bool) -> float:
    """Of the rays of every element, those that a bake will trace."""
    return SAMPLED / 0.5 if is_sparse(settings, highlights) else 1.0


def forecast_seconds(settings: BakeSettings, receivers: int, columns: int, highlights: bool) -> float:
    """What sparse sampling takes besides rays."""
    return overhead(columns) * receivers * columns if is_sparse(settings, highlights) else 0.0


def dense_bytes(settings: BakeSettings, receivers: int, columns: int) -> float:
    """Of memory for the rows of dense receivers, which go to a file beyond the budget, and for blocks of others."""
    if not is_sparse(settings):
        return 0.0
    budget = array_budget(settings)
    held = min(4 * receivers * columns, budget or np.inf) + min(receivers * columns, budget or np.inf)
    return SparseSettings().dense * held + BLOCK_BYTES * min(receivers, VERTICES) * columns


def choose(elements: TexelElements, settings: BakeSettings, shadow_rays: bool, highlights: bool = False,
           ) -> tuple[bool, LeftOut | None]:
    """Whether to sample sparsely, and why not where it isn't that every element was asked for. highlights: what they
    need of single texels is collected on the way."""
    if settings.sampling == "every":
        return False, None
    if not shadow_rays:
        return False, LeftOut(SPARSE, "nothing casts a shadow: every element is known without a ray", SAVED)
    if highlights:
        return False, LeftOut(SPARSE, "highlights need to know what every texel shows", SAVED)
    coarse = elements.r < SMALLEST
    if settings.sampling == "sparse":
        why = f"a cubemap of {elements.r} texels along an edge is too coarse for it"
        return not coarse, LeftOut(SPARSE, why, SAVED) if coarse else None
    seconds = element_seconds(elements, settings.seed)
    found = plan(len(elements), elements.columns, seconds, harder=HARDER_RAYS)
    exact_enough = settings.compression_error >= TYPICAL_ERROR and not coarse
    if found.pays and exact_enough:
        return True, None
    return False, sparse_line(found, "it gains too little for its error" if exact_enough else
                              "its error, about 1 %, is above compression_error")


def sparse_direct(elements: TexelElements, scene: SceneMesh, basis: DistantBasis, settings: BakeSettings,
                  light: ReferenceLight | None, folder: Path | None) -> Generator[float, None, SampledDirect]:
    """Yield progress, return the direct light of receivers from a part of its elements, with the error of receivers at
    random, all of whose elements are traced."""
    positions = scene.points[elements.receivers.key % len(scene.points)]
    found = yield from sparse_transfer(elements, positions, elements.receivers.normals,
                                       sparse_settings(positions, settings.seed), array_budget(settings), folder)
    error = measured_error(elements, found, basis, light, settings.seed)
    facts = {"chosen": "sparse", "traced": found.sampled, "dense": float(found.dense.mean()),
             "elements": found.dense_elements + found.sparse_elements, "of": int(found.transfer.size),
             "neighbours": found.neighbours, **error}
    return SampledDirect(found.transfer.T, found.dense, facts)


def sparse_settings(positions: NDArray[np.float64], seed: int) -> SparseSettings:
    """As published, but for the radius: within it most receivers at positions (r, 3) have NEIGHBOURS dense ones,
    however dense the mesh is and however far apart its parts are."""
    usual = SparseSettings(seed=seed)
    count = min(len(positions), round(NEIGHBOURS / usual.dense))
    some = np.random.default_rng(seed).permutation(len(positions))[:CHECKED]
    distance, _ = KDTree(positions).query(positions[some], k=[count])
    radius, whole = float(np.percentile(distance, MOST_OF_THEM)), bounding_diagonal([positions])
    return replace(usual, radius=radius / whole) if radius > 0.0 and whole > 0.0 else usual


def measured_error(elements: TexelElements, found: SparseTransfer, basis: DistantBasis, light: ReferenceLight | None,
                   seed: int) -> dict[str, Any]:
    """Relative RMS of single elements and of the light that they give under the scene's light, at receivers at random
    (all of them where there are fewer than CHECKED). Its rays count as the bake's."""
    generator = np.random.Generator(np.random.PCG64([seed, 85]))
    count = min(CHECKED, len(elements))
    chosen = np.sort(generator.choice(len(elements), count, replace=False))
    column, row = np.nonzero(elements.unknown(chosen).T)
    truth = np.zeros((count, elements.columns), np.float32)
    truth[row, column] = elements.evaluate(chosen[row], column)
    truth *= elements.factor(chosen)
    woven = np.ascontiguousarray(found.transfer[:, chosen].T)
    colours = basis.coefficients(light or stand_in_light()).astype(np.float32)
    lit, exact = multiply(woven, colours), multiply(truth, colours)
    return {"element_error": _relative(woven - truth, truth), "light_error": _relative(lit - exact, exact),
            "checked": count}


def _relative(difference: Single, truth: Single) -> float:
    power = float(np.sum(np.square(truth, dtype=np.float64)))
    return float(np.sqrt(np.sum(np.square(difference, dtype=np.float64)) / power)) if power > 0.0 else 0.0


def sampling_checks(facts: dict[str, Any]) -> list[dict[str, Any]]:
    """The line of the stability table; none where every element was traced."""
    if facts.get("chosen") != "sparse":
        return []
    good = facts["light_error"] <= LIMIT
    check = f"error of light by sparse sampling, at {facts['checked']} receivers ({facts['traced']:.0%} traced)"
    return [{"check": check, "value": facts["light_error"], "limit": LIMIT,
             "verdict": "ok" if good else "shadows are woven from too few samples: use sampling=every"}]


def dense_points(scene: SceneMesh, receivers: ReceiverSet, dense: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
    """By the scene's points, whose front was sampled as dense."""
    if dense is None:
        return None
    points = np.zeros(len(scene.points), bool)
    points[receivers.key[dense & (receivers.key < len(points))]] = True
    return points


def can_start_dense(dense: NDArray[np.bool_], encoder: str) -> bool:
    """Whether an object's points (p,) are encoded dense first: by clustered PCA, with some sparse ones to spare."""
    return encoder in METHODS and 0 < int(dense.sum()) < len(dense)


def encode_from_dense(signal: Single, dense: NDArray[np.bool_], positions: NDArray[np.float64],
                      settings: EncoderSettings, progress: Progress | None) -> Encoding:
    """Clustered PCA of the dense points, which the others at positions (p, 3) join."""
    numbers = np.flatnonzero(dense)
    joins = numbers[KDTree(positions[dense]).query(positions)[1]]
    joins[numbers] = numbers  # of points at one place any is nearest
    return encode_dense_first(signal, dense, joins, settings, progress)
