# SPDX-License-Identifier: GPL-3.0-or-later
"""The report as a JSON file: checked against what scripts may rely on, before it is written and after it is read."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from ..errors import StorageError
from ..storage.files import save_json

SCHEMA = 1

NUMBER = (int, float, type(None))  # null: could not be measured (JSON has no NaN)
# The promised part of each report: names may be added, never renamed. A list means "entries like this one".
_SHAPE: dict[str, Any] = {
    "schema": int,
    "scene": {"objects": list, "receivers": int, "triangles": int},
    "settings": dict,
    "seconds": NUMBER,
    "peak_bytes": int,
    "rays": int,
    "rays_per_second": NUMBER,
    "stages": [{"name": str, "seconds": NUMBER, "rays": int, "peak_bytes": int}],
    "left_out": [{"what": str, "why": str, "saved": str}],
    "errors": dict,
    "clusters": {"count": int, "vectors_mean": NUMBER, "squared_error": NUMBER, "overdraw": NUMBER},
    "stability": [{"check": str, "value": NUMBER, "limit": NUMBER, "verdict": str}],
}
# `errors` is empty where the reference was switched off, else it holds all four.
ERROR_NAMES = ("sampling", "basis", "compression", "total")
# `highlight_errors` is absent or empty where no highlight was baked or measured, else it holds all six.
HIGHLIGHT_ERROR_NAMES = ("sampling", "rows", "basis", "bounces", "compression", "total")
_ERROR_SHAPE: dict[str, Any] = {"relative_rms": NUMBER, "interval": list, "receivers": int, "reference_rays": int}


def problem_of(report: Any) -> str | None:
    """What is wrong with a report, as "place: cause", or None."""
    if not isinstance(report, dict):
        return "the file: not a JSON object"
    if isinstance(report.get("schema"), int) and report["schema"] > SCHEMA:
        return f"schema {report['schema']}: written by a newer version of the extension"
    problem = _mismatch(report, _SHAPE, "")
    if problem is None and report["errors"]:
        problem = _mismatch(report["errors"], dict.fromkeys(ERROR_NAMES, _ERROR_SHAPE), "errors.")
    if problem is None and report.get("highlight_errors"):
        problem = _mismatch(report["highlight_errors"], dict.fromkeys(HIGHLIGHT_ERROR_NAMES, _ERROR_SHAPE),
                            "highlight_errors.")
    if problem is None:
        for key in ("errors", "highlight_errors"):
            for name, entry in (report.get(key) or {}).items():
                interval = entry["interval"]
                if len(interval) != 2 or not all(isinstance(end, NUMBER) for end in interval):
                    return f"{key}.{name}.interval: not two numbers"
    return problem


def _mismatch(value: Any, shape: Any, place: str) -> str | None:
    """Where a JSON value first differs from a shape."""
    if isinstance(shape, dict):
        if not isinstance(value, dict):
            return f"{place.rstrip('.')}: not an object"
        for name, inner in shape.items():
            if name not in value:
                return f"{place}{name}: missing"
            problem = _mismatch(value[name], inner, f"{place}{name}.")
            if problem is not None:
                return problem
        return None
    if isinstance(shape, list):
        if not isinstance(value, list):
            return f"{place.rstrip('.')}: not a list"
        problems = (_mismatch(entry, shape[0], f"{place}{index}.") for index, entry in enumerate(value))
        return next((problem for problem in problems if problem is not None), None)
    if isinstance(value, bool) or not isinstance(value, shape):
        return f"{place.rstrip('.')}: {value!r} is of the wrong type"
    return None


def write_report(path: Path, report: dict[str, Any]) -> None:
    """Write a report, atomically; numbers that are not finite become null.

    Raises StorageError where the file can't be written, ValueError for a report that breaks the promise (our defect).
    """
    finite = _finite(report)
    problem = problem_of(finite)
    if problem is not None:
        raise ValueError(f"report: {problem}")
    save_json(path, finite)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(name): _finite(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def read_report(path: Path) -> dict[str, Any]:
    """A report written by `write_report`. Raises StorageError where it is missing, broken, newer or something else."""
    remedy = "Give a report that `prt bake --report` wrote"
    try:
        report = json.loads(path.read_bytes())
    except OSError as error:
        raise StorageError(str(path), f"can't be read ({error.strerror or error})", remedy) from error
    except (ValueError, RecursionError) as error:
        raise StorageError(str(path), "is not a JSON file", remedy) from error
    problem = problem_of(report)
    if problem is not None:
        newer = "schema " in problem and "newer" in problem
        raise StorageError(str(path), f"is not a report of this version ({problem})",
                           "Install the newer version of the extension" if newer else remedy)
    return report
