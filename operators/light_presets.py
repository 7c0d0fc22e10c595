# SPDX-License-Identifier: GPL-3.0-or-later
"""prt.light_preset_add, _apply, _update, _remove; prt.light_solo, prt.light_switch."""

from __future__ import annotations

from collections.abc import Callable

import bpy
from bpy.props import StringProperty

from ..prt_addon.blender.light_state import TAKES_OVER, is_on, lights_of, set_light
from ..prt_addon.errors import BadScene, PRTError
from .light_design import end_solo, preset_named, recall, solo, store
from .light_properties import unique_name
from .properties import redraw


class _LightOperator(bpy.types.Operator):
    """What operators of lights share: one undo step each, one report each."""

    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not context.scene.is_editable:
            cls.poll_message_set("The scene is linked from another file: presets can't be kept in it")
            return False
        return True

    def attempt(self, context: bpy.types.Context, work: Callable[[], tuple[str, list[str]]]) -> set[str]:
        """Do the work, which gives a text for the user and lines about what was left out."""
        try:
            text, notes = work()
        except PRTError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        # Who keys one preset after the other expects it of keyframes to take over.
        expected = TAKES_OVER.format("")
        self.report({"INFO"} if all(note.endswith(expected) for note in notes) else {"WARNING"},
                    "; ".join([text, *notes]))
        context.view_layer.update()
        redraw("UI")
        return {"FINISHED"}


class _PresetOperator(_LightOperator):
    """One that needs a preset."""

    name: StringProperty(name="Name", options={"SKIP_SAVE"},
                         description="Name of the preset; empty is the one used last")

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not context.scene.prt_light.presets:
            cls.poll_message_set("There is no light preset yet: add one")
            return False
        return super().poll(context)


class PRT_OT_light_preset_add(_LightOperator):
    """Store the present light, as World, HDRI and all lights are set, under a new name. The preview draws its
    thumbnail, which takes about as long as a few frames. Costs some kilobytes in the file"""

    bl_idname = "prt.light_preset_add"
    bl_label = "Add Light Preset"

    name: StringProperty(name="Name", options={"SKIP_SAVE"}, description="Name of the preset; a number is added "
                                                                         "where it is taken")

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.attempt(context, lambda: self._add(context))

    def _add(self, context: bpy.types.Context) -> tuple[str, list[str]]:
        lighting = context.scene.prt_light
        names = [preset.name for preset in lighting.presets]
        wanted = self.name.strip() or f"Light {len(names) + 1}"
        preset = lighting.presets.add()
        preset.name = unique_name(wanted, names)
        lighting.active = len(lighting.presets) - 1
        notes = store(context, preset)
        return f"Stored the light as {preset.name}", notes


class PRT_OT_light_preset_apply(_PresetOperator):
    """Light the scene as this preset was stored: World, HDRI, and the lights' power, color, shape, place and switches.
    Costs one relighting. Lights added since are left as they are"""

    bl_idname = "prt.light_preset_apply"
    bl_label = "Apply Light Preset"

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.attempt(context, lambda: self._apply(context))

    def _apply(self, context: bpy.types.Context) -> tuple[str, list[str]]:
        place, preset = preset_named(context.scene, self.name)
        notes = recall(context.scene, preset)
        context.scene.prt_light.active = place
        return f"Lit by {preset.name}", notes


class PRT_OT_light_preset_update(_PresetOperator):
    """Store the present light in this preset, in place of what it held, with a new thumbnail. Costs what adding one
    costs; the preset's previous light is gone, unless you undo"""

    bl_idname = "prt.light_preset_update"
    bl_label = "Update Light Preset"

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.attempt(context, lambda: self._update(context))

    def _update(self, context: bpy.types.Context) -> tuple[str, list[str]]:
        place, preset = preset_named(context.scene, self.name)
        notes = store(context, preset)
        context.scene.prt_light.active = place
        return f"{preset.name} is the present light now", notes


class PRT_OT_light_preset_remove(_PresetOperator):
    """Remove this preset. The scene's light stays as it is"""

    bl_idname = "prt.light_preset_remove"
    bl_label = "Remove Light Preset"

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.attempt(context, lambda: self._remove(context))

    def _remove(self, context: bpy.types.Context) -> tuple[str, list[str]]:
        lighting = context.scene.prt_light
        place, preset = preset_named(context.scene, self.name)
        text = f"Removed {preset.name}"
        lighting.presets.remove(place)
        if lighting.active >= place:
            lighting.active = lighting.active - 1 if lighting.active > place else -1
        return text, []


class PRT_OT_light_solo(_LightOperator):
    """Leave this light on alone, with the others and the World off; click again to put all back as it was. Costs one
    relighting"""

    bl_idname = "prt.light_solo"
    bl_label = "Solo"

    name: StringProperty(name="Light", options={"SKIP_SAVE"},
                         description="Name of the light's object; empty is the World")

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.attempt(context, lambda: self._solo(context))

    def _solo(self, context: bpy.types.Context) -> tuple[str, list[str]]:
        notes = solo(context.scene, self.name)
        alone = context.scene.prt_light.soloing
        return f"{self.name or 'The World'} alone" if alone else "All lights as before", notes


class PRT_OT_light_switch(_LightOperator):
    """Switch this light on or off, in viewports and in renders. Costs one relighting"""

    bl_idname = "prt.light_switch"
    bl_label = "On or Off"

    name: StringProperty(name="Light", options={"SKIP_SAVE"}, description="Name of the light's object")

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.attempt(context, lambda: self._switch(context))

    def _switch(self, context: bpy.types.Context) -> tuple[str, list[str]]:
        light = next((found for found in lights_of(context.scene) if found.name_full == self.name), None)
        if light is None:
            raise BadScene(self.name, "the scene has no light of this name", "Check the spelling and the scene")
        notes: list[str] = []
        set_light(light, not is_on(light), notes)
        return f"{light.name} is {'on' if is_on(light) else 'off'}", notes


class PRT_OT_light_solo_end(_LightOperator):
    """Put all lights and the World back as they were before the solo"""

    bl_idname = "prt.light_solo_end"
    bl_label = "End Solo"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not context.scene.prt_light.soloing:
            cls.poll_message_set("No light is alone")
            return False
        return super().poll(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        def end() -> tuple[str, list[str]]:
            end_solo(context.scene)
            return "All lights as before", []
        return self.attempt(context, end)


CLASSES = (PRT_OT_light_preset_add, PRT_OT_light_preset_apply, PRT_OT_light_preset_update, PRT_OT_light_preset_remove,
           PRT_OT_light_solo, PRT_OT_light_solo_end, PRT_OT_light_switch)
