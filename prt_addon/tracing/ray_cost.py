# SPDX-License-Identifier: GPL-3.0-or-later
"""What tracing costs on the GPU and on the CPU of this machine, as measured there, and which of them gets a bucket.

    GPU(R, T) = R T / fill + R gamma / readback        (Carr, Hall & Hart 2002, The Ray Engine, equation 11)

R rays against T triangles; fill: tests per second; gamma: bytes read back per ray; readback: bytes per second. What the
paper leaves out counts today: rays have to be sent as well (upload), every dispatch has a fixed cost (latency), and a
ray meets its triangles one after the other (step), so that few rays leave a large GPU idle:

    GPU(R, T) = latency + max(R T / fill, T step) + R gamma / readback + R sent / upload

`published` is the paper's form, `seconds` this one. Pure Python and numpy.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

NEAREST_BYTES, OCCLUDED_BYTES = 16.0, 0.25  # read back per ray: distance, triangle, two weights; or one bit
SENT_BYTES = 32.0  # per ray: origin, reach and direction, each four numbers
SCHEMA = 1
# Slices of work, and other programs, make a forecast unsafe: the GPU has to be faster by this much.
LEAST_GAIN = 1.2


@dataclass(frozen=True)
class Calibration:
    """Measured once per machine. device: name of the graphics driver; fill: ray-triangle tests per second; readback,
    upload: bytes per second; latency: seconds of an empty dispatch with its readback; step: seconds from one test of a
    ray to its next, however few rays there are; traversal: rays per second of the kernel that walks the tree, without
    transfers; nearest_rays, occluded_rays: rays per second of the GPU, all
    included; embree_rays: of Embree's shadow rays with `threads` threads on the same scene."""

    device: str
    fill: float
    readback: float
    upload: float
    latency: float
    step: float
    traversal: float
    nearest_rays: float
    occluded_rays: float
    embree_rays: float
    threads: int

    def published(self, rays: float, triangles: float, read_bytes: float = NEAREST_BYTES) -> float:
        """Seconds for all pairs of rays and triangles by equation 11."""
        return rays * triangles / self.fill + rays * read_bytes / self.readback

    def seconds(self, rays: float, triangles: float, read_bytes: float = NEAREST_BYTES) -> float:
        """The same with what the paper leaves out."""
        return self.on_device(rays, triangles, read_bytes) + rays * SENT_BYTES / self.upload

    def on_device(self, rays: float, triangles: float, read_bytes: float = NEAREST_BYTES) -> float:
        """The same for rays that are there already."""
        tests = max(rays * triangles / self.fill, triangles * self.step)
        return self.latency + tests + rays * read_bytes / self.readback

    def least_triangles(self, share: float = 0.5) -> int:
        """How many triangles a cell needs so that tests take at least this share of equation 11 (the paper's T_min)."""
        return math.ceil(share / (1.0 - share) * NEAREST_BYTES / self.readback * self.fill)

    def to_json(self) -> str:
        """As text for a file."""
        return json.dumps({"schema": SCHEMA, **asdict(self)}, indent=1)

    @staticmethod
    def from_json(text: str) -> Calibration | None:
        """From such a text; None for one that is none, is damaged or of another schema: then measure again."""
        try:
            values: dict[str, Any] = json.loads(text)
            if not isinstance(values, dict) or values.pop("schema", None) != SCHEMA:
                return None
            found = Calibration(**values)
        except (ValueError, TypeError):
            return None
        numbers = [getattr(found, field.name) for field in fields(found) if field.type in ("float", "int")]
        good = all(isinstance(n, int | float) and not isinstance(n, bool) and math.isfinite(n) and n > 0.0
                   for n in numbers)
        return found if good and isinstance(found.device, str) else None


@dataclass(frozen=True)
class TracerChoice:
    """gpu: whether the GPU takes part; why: in words; left_out: why it is left out, with numbers, "" where it takes
    part or was never measured."""

    gpu: bool
    why: str
    left_out: str = ""


def choose_tracer(calibration: Calibration | None, threads: int) -> TracerChoice:
    """Embree alone, or the GPU beside it: only where it was measured faster than all threads of Embree.

    threads: that the bake will use; Embree's rate is scaled to them.
    """
    if calibration is None:
        return TracerChoice(False, "Embree: the GPU's speed at tracing was not measured on this computer")
    embree = calibration.embree_rays * threads / calibration.threads
    gpu, device = calibration.occluded_rays, short_name(calibration.device)
    if gpu < LEAST_GAIN * embree:
        return TracerChoice(False, f"Embree: {mega(embree)} here, the GPU {mega(gpu)} ({device}), left out",
                            f"it traces {mega(gpu)} here ({device}) and Embree {mega(embree)}")
    return TracerChoice(True, f"the GPU beside Embree: {mega(gpu)} ({device}), Embree {mega(embree)}")


def short_name(device: str) -> str:
    """A driver's name without its versions and buses: "NVIDIA H200" of "NVIDIA H200/PCIe/SSE2, OPENGL"."""
    return device.partition("/")[0].partition(" (")[0].partition(",")[0]


def mega(rays: float) -> str:
    """Rays per second in words."""
    return f"{rays / 1e6:.3g} Mray/s"


def gpu_share(gpu_seconds: NDArray[np.float64], cpu_seconds: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which buckets go to the GPU so that both, side by side, end earliest: (buckets,) bool.

    gpu_seconds, cpu_seconds: what each bucket costs here and there. Those where the GPU wins most come first, until
    what it has takes as long as the rest on the CPU.
    """
    by_gain = np.argsort(gpu_seconds / np.maximum(cpu_seconds, np.finfo(np.float64).tiny), kind="stable")
    on_gpu = np.concatenate([[0.0], np.cumsum(gpu_seconds[by_gain])])
    on_cpu = np.concatenate([[0.0], np.cumsum(cpu_seconds[by_gain[::-1]])])[::-1]
    taken = int(np.argmin(np.maximum(on_gpu, on_cpu)))
    chosen = np.zeros(len(by_gain), bool)
    chosen[by_gain[:taken]] = True
    return chosen
