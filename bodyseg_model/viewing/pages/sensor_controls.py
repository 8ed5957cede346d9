"""The controls of a sensor's artifacts on a page: each can be left out, and has its strengths."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from bodyseg_data.artifacts.artifact import Artifact
from bodyseg_data.artifacts.sensor_model import SensorModel
from bodyseg_data.core.errors import BadConfig
from bodyseg_model.viewing.strengths import Choice, Control, Slider, controls_of, moved, value_of

if TYPE_CHECKING:
    import viser

    from bodyseg_model.viewing.pages.page import Page

_KINDS: Final = {"occlusion": "occ", "noise": "noise", "missing_data": "md"}
_NONE: Final = "none"


class SensorState:
    """A sensor model as its controls leave it: artifacts with other strengths, and those that are left out."""

    def __init__(self, model: SensorModel) -> None:
        self._artifacts = {artifact.name: artifact for artifact in model}
        self._model, self._left_out = model, set[str]()

    def __repr__(self) -> str:
        return f"SensorState({self.model!r})"

    @property
    def model(self) -> SensorModel:
        """The model with the artifacts that are not left out."""
        return self._model.with_artifacts(*self._artifacts.values()).without(*self._left_out)

    def artifact(self, name: str) -> Artifact:
        """The artifact of this name with its strengths, also where it is left out."""
        return self._artifacts[name]

    def leave_out(self, name: str, left_out: bool) -> None:
        """Leave an artifact out, or take it in again."""
        (self._left_out.add if left_out else self._left_out.discard)(name)

    def move(self, name: str, control: Control, value: Any) -> bool:
        """Set a strength (`moved`); False if nothing changed. Raises BadConfig for a value that it cannot have."""
        changed = moved(self._artifacts[name], control, value)
        if changed == self._artifacts[name]:
            return False
        self._artifacts[name] = changed
        return True


class SensorControls:
    """Puts controls of a model into the page's current container. changed: is called with the new model."""

    def __init__(self, page: Page, model: SensorModel, changed: Callable[[SensorModel], None]) -> None:
        self._page, self._changed = page, changed
        self._lock = threading.RLock()
        self._folder = page.server.gui.add_folder("artifacts")
        self._handles: dict[str, list[tuple[Control, Any]]] = {}
        self._folders: list[viser.GuiFolderHandle] = []
        self.put(model)

    def __repr__(self) -> str:
        return f"SensorControls({self.state!r})"

    def put(self, model: SensorModel) -> None:
        """Show the controls of another model in place of those shown."""
        with self._lock:
            self.state = SensorState(model)
            for each in self._folders:
                each.remove()
            self._handles, self._folders = {}, []
            with self._folder:
                for artifact in model:
                    self._add(artifact)

    def _add(self, artifact: Artifact) -> None:
        gui = self._page.server.gui
        name = artifact.name
        folder = gui.add_folder(f"{name.replace('_', ' ')} ({_KINDS[artifact.kind]})")
        self._folders.append(folder)
        with folder:
            kept = gui.add_checkbox("applied", True)
            handles = [(control, self._handle(artifact, control)) for control in controls_of(artifact)]
        self._handles[name] = handles

        @kept.on_update
        def _(_: object) -> None:
            with self._lock:
                self.state.leave_out(name, not kept.value)
            self._changed(self.state.model)

        for control, handle in handles:
            handle.on_update(self._mover(name, control, handle))

    def _handle(self, artifact: Artifact, control: Control) -> Any:
        gui, value = self._page.server.gui, value_of(artifact, control)
        if isinstance(control, Slider):
            if control.whole:
                return gui.add_slider(control.label, round(control.low), round(control.high), 1, value)
            return gui.add_slider(control.label, control.low, control.high, control.step, float(value))
        if isinstance(control, Choice):
            return gui.add_dropdown(control.label, tuple(map(_text, control.values)), initial_value=_text(value))
        hint = "several values with ; between them" if control.several else "empty: what the artifact takes by itself"
        return gui.add_text(control.label, value, hint=hint)

    def _mover(self, name: str, control: Control, handle: Any) -> Callable[[object], None]:
        def move(_: object) -> None:
            with self._lock:
                if all(handle is not each for _, each in self._handles.get(name, ())):
                    return  # of a model that is no longer shown
                given = handle.value
                if isinstance(control, Choice):
                    given = next(value for value in control.values if _text(value) == given)
                try:
                    if not self.state.move(name, control, given):
                        return
                except BadConfig as error:
                    self._page.warn(str(error))
                    return
                self._follow(name)
            self._changed(self.state.model)

        return move

    def _follow(self, name: str) -> None:
        """Show the strengths that changed with the one that was moved."""
        artifact = self.state.artifact(name)
        for control, handle in self._handles[name]:
            value = value_of(artifact, control)
            shown = _text(value) if isinstance(control, Choice) else value
            if handle.value != shown:
                handle.value = shown


def _text(value: Any) -> str:
    return _NONE if value is None else f"{value:g}" if isinstance(value, float) else str(value)
