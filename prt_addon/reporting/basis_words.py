# SPDX-License-Identifier: GPL-3.0-or-later
"""What a report says of the columns of distant light and their encoder: of harmonics, of a cubemap, of eigentransport,
and why one of them was chosen."""

from __future__ import annotations

from typing import Any

from .wording import ERRORS, duration, memory

Report = dict[str, Any]
Words = dict[str, tuple[str, str, str]]

TEXELS = ("Texels of the sky", "the light is stored in the texels of a cubemap, so shadows of small bright lights are "
          "blurred by a texel", "more texels (cubemap_size)")
ONE_BASIS = ("Compression", "all points share one set of vectors, which rings in the shadows of small bright lights",
             "more vectors, or clusters (another encoder)")


def diffuse_words(report: Report) -> Words:
    """`wording.ERRORS` for the basis and the encoder of this bake."""
    words = dict(ERRORS)
    if uses_cubemap(report):
        words["basis"] = TEXELS
    if uses_one_basis(report):
        words["compression"] = ONE_BASIS
    return words


def uses_cubemap(report: Report) -> bool:
    """Whether distant light is in texels."""
    settings = report.get("settings") or {}
    return settings.get("distant_basis") == "cubemap" and settings.get("lighting") != "local"


def uses_one_basis(report: Report) -> bool:
    """Whether all points of an object share one cluster."""
    settings = report.get("settings") or {}
    return settings.get("encoder") == "eigentransport" and "local" not in str(settings.get("lighting", ""))


def basis_line(report: Report) -> str:
    """What the sky is held in, and why where that was chosen; "" for reports that don't tell."""
    choice = report.get("choice") or {}
    return str(choice.get("line") or report.get("basis") or "")


def candidate_rows(report: Report, percent: Any) -> list[list[str]]:
    """What an automatic choice weighed, one row each: basis, predicted error, data, seconds. percent: how a share is
    written."""
    rows = []
    for found in (report.get("choice") or {}).get("candidates") or []:
        if "order" in found:
            name = f"harmonics of order {found['order']}"
        else:
            held = f"{found['vectors']} vectors for all" if found["encoder"] == "eigentransport" else "clusters"
            name = f"cubemap of {found['cubemap_size']} texels, {held}"
        rows.append([name, percent(found["predicted_error"]), memory(found["stored_bytes"]),
                     duration(found["seconds"])])
    return rows
