# SPDX-License-Identifier: GPL-3.0-or-later
"""One press on Bake or Resume: what is to be baked and how, until its turn comes.

The scene is read when it is the request's turn: reading it at once would hold every waiting scene in memory. Objects
are known by identity, so that one renamed meanwhile is found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import bpy

from ..prt_addon.baking.claims import discard_if_free
from ..prt_addon.baking.record import JobRecord
from ..prt_addon.baking.settings import BakeSettings
from ..prt_addon.blender.read_scene import selected_names
from ..prt_addon.errors import BadScene
from .bake_session import BakeSession
from .place import Place

AFRESH = "The scene, its light or the extension changed since the interruption, so it was baked afresh"
NAMED = 2  # objects that a title names; the rest is counted


@dataclass(frozen=True)
class BakeRequest:
    """title: what a line of the panel calls it. selected: names and identities of what was selected, empty for all
    visible meshes. asked: of what was asked for whatever is selected (a collection's), None for what is selected.
    resumes: folder and record of an interrupted bake."""

    title: str
    place: Place
    settings: BakeSettings
    selected: dict[str, int] = field(default_factory=dict)
    asked: dict[str, int] | None = None
    resumes: tuple[Path, JobRecord] | None = None

    @staticmethod
    def of_choice(context: bpy.types.Context, settings: BakeSettings, asked: Sequence[str] | None) -> BakeRequest:
        """The objects that were asked for, or None: those selected now."""
        names = selected_names(context.view_layer)
        present = {o.name_full: o.session_uid for o in context.scene.objects}
        missing = [name for name in asked or () if name not in present]
        if missing:
            raise BadScene(missing[0], "it is not in this scene", "Check the name, or choose another collection")
        return BakeRequest(title_of(names if asked is None else asked), Place.of(context), settings,
                           {name: present[name] for name in names},
                           None if asked is None else {name: present[name] for name in asked})

    @staticmethod
    def of_interrupted(folder: Path, record: JobRecord) -> BakeRequest:
        """An interrupted bake, as it was asked for. Raises PRTError."""
        place = Place.named(record.scene, record.view_layer)
        present = {o.name_full: o.session_uid for o in place.find().objects}
        missing = [name for name in (record.selected if record.asked is None else record.asked) if name not in present]
        if missing:
            raise BadScene(missing[0], "deleted or renamed since its bake was interrupted",
                           "Discard the interrupted bake, and bake again")
        return BakeRequest(title_of(record.objects), place, record.bake_settings(),
                           {name: present[name] for name in record.selected if name in present},
                           None if record.asked is None else {name: present[name] for name in record.asked},
                           (folder, record))

    def start(self) -> BakeSession:
        """Read the scene and start the child. Raises PRTError."""
        selected, gone = self._names_now(self.selected)
        asked = None
        if self.asked is not None:
            asked, gone = self._names_now(self.asked)
        depsgraph = self.place.depsgraph()
        if self.resumes is not None:
            complete = BakeSession.of_complete(*self.resumes, depsgraph)
            if complete is not None:
                return complete
        job = BakeSession.start(depsgraph, self.settings, asked, selected)
        job.notes += [f"{name} was deleted before its turn" for name in gone]
        if self.resumes is not None and job.job != self.resumes[0] and discard_if_free(self.resumes[0]):
            job.notes.append(AFRESH)
        return job

    def object_in_use(self) -> str | None:
        """An object of the scene that is in edit mode: its mesh is not finished, so that reading has to wait."""
        try:
            return next((o.name for o in self.place.find().objects if o.mode == "EDIT"), None)
        except BadScene:
            return None  # `start` says it

    def _names_now(self, identities: dict[str, int]) -> tuple[list[str], list[str]]:
        """Names of now of these objects, and names of those that are gone. Raises BadScene where all are, if the bake
        is of them."""
        present = {o.session_uid: o.name_full for o in self.place.find().objects}
        gone = [name for name, identity in identities.items() if identity not in present]
        if gone and len(gone) == len(identities) and (self.asked is None or identities is self.asked):
            raise BadScene(title_of(gone), "deleted before its turn to be baked", "Undo that and bake again")
        return [present[identity] for identity in identities.values() if identity in present], gone


def title_of(names: Sequence[str]) -> str:
    """"Statue", "Statue, Floor", "Statue, Floor and 3 more"; without names all."""
    if not names:
        return "All visible meshes"
    text = ", ".join(names[:NAMED])
    return text if len(names) <= NAMED else f"{text} and {len(names) - NAMED} more"
