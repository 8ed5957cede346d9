"""The controls of a set's page: a sample, its variant, and the strengths of a sensor's artifacts."""

import shlex
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from bodyseg_data.artifacts import PAIRS, VARIANTS, Artifact, SensorModel, load_sensor_model, sensor_model_names
from bodyseg_data.core import BadConfig, BodysegError, reported
from bodyseg_data.samples import READ_SPLITS, SPLITS, ReadSplit
from bodyseg_model.viewing.page import Controls, Page
from bodyseg_model.viewing.set_view import COLOURINGS, SetView, Shown
from bodyseg_model.viewing.strengths import Slider, moved, sliders_of, value_of

if TYPE_CHECKING:
    import viser


_KINDS: Final = {"occlusion": "occ", "noise": "noise", "missing_data": "md"}


class SensorState:
    """A sensor model as its controls leave it: artifacts with other strengths, and those that are left out."""

    def __init__(self, model: SensorModel) -> None:
        self._all, self.left_out = model, set[str]()

    @property
    def model(self) -> SensorModel:
        """The model with the artifacts that are not left out."""
        return self._all.without(*self.left_out)

    def artifact(self, name: str) -> Artifact:
        """The artifact of this name with its strengths, also where it is left out."""
        return next(artifact for artifact in self._all if artifact.name == name)

    def move(self, name: str, slider: Slider, value: float) -> bool:
        """Set a strength (`moved`); False if nothing changed. Raises BadConfig for a value that it cannot have."""
        before = self._all
        self._all = before.with_artifacts(moved(self.artifact(name), slider, value))
        return self._all != before


class SensorControls:
    """Puts controls of a model into the page's current container. changed: is called with the new model."""

    def __init__(self, page: Page, model: SensorModel, changed: Callable[[SensorModel], None]) -> None:
        self._page, self._changed = page, changed
        self._lock = threading.RLock()
        self._folder = page.server.gui.add_folder("artifacts")
        self._handles: dict[str, list[tuple[Slider, Any]]] = {}
        self._folders: list[viser.GuiFolderHandle] = []
        self.put(model)

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
            handles = [(slider, self._handle(artifact, slider)) for slider in sliders_of(artifact)]
        self._handles[name] = handles

        @kept.on_update
        def _(_: object) -> None:
            with self._lock:
                (self.state.left_out.discard if kept.value else self.state.left_out.add)(name)
            self._changed(self.state.model)

        for slider, handle in handles:
            handle.on_update(self._mover(name, slider, handle))

    def _handle(self, artifact: Artifact, slider: Slider) -> Any:
        gui, value = self._page.server.gui, value_of(artifact, slider)
        if slider.whole:
            return gui.add_slider(slider.label, round(slider.low), round(slider.high), 1, round(value))
        return gui.add_slider(slider.label, slider.low, slider.high, slider.step, float(value))

    def _mover(self, name: str, slider: Slider, handle: Any) -> Callable[[object], None]:
        def move(_: object) -> None:
            with self._lock:
                if all(handle is not each for _, each in self._handles.get(name, ())):
                    return  # of a model that is no longer shown
                try:
                    if not self.state.move(name, slider, handle.value):
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
        for slider, handle in self._handles[name]:
            value = value_of(artifact, slider)
            if handle.value != value:
                handle.value = value


_BOTH: Final = "train and test"


class SetPage(Controls):
    """Puts a set on a page and keeps what its controls say. first: what is shown first."""

    def __init__(self, page: Page, view: SetView, first: Shown) -> None:
        super().__init__(page, view, first)
        self._sensors = {name: load_sensor_model(name) for name in sensor_model_names()} | {
            first.sensor.name: first.sensor
        }
        gui = page.server.gui
        with gui.add_folder("Sample"):
            self._add_sample_controls()
        with gui.add_folder("Image"):
            self._add_image_controls()
        page.add_view_controls()
        with gui.add_folder("Sensor: strengths of its artifacts"):
            self._add_sensor_controls()
        page.start(self.draw)

    def choose(self, split: str, where: str, only: str) -> None:
        """Show other samples of the set, from the first on; where it refuses, say so and keep what is shown.

        split: one of `SPLITS`, else all. where, only: conditions and patterns, divided into words as by a shell.
        """
        chosen: ReadSplit | None = next((each for each in READ_SPLITS if each == split), None)
        try:
            view = self.view.chosen(chosen, _words(only), _words(where))
        except BodysegError as error:
            self.page.warn(str(error))
            return
        with self._lock:
            self.view = view
            self._index.max = max(1, len(view) - 1)
            self._index.value = 0
            self._key.value = view.images.location(0)[1]
        self.change(index=0)

    def _add_sample_controls(self) -> None:
        gui = self.page.server.gui
        splits = (_BOTH, *(SPLITS if not self.view.val_share else READ_SPLITS))
        split = gui.add_dropdown("split", splits, initial_value=self.view.images.split or _BOTH)
        selection = self.view.images.selection
        hint = "conditions with spaces between them, like distance_cm<=255 subject=B,C azimuth_deg=-90..90"
        texts = " ".join(shlex.quote(condition.text) for condition in selection.where)
        where = gui.add_text("where", texts, hint=hint)
        only = gui.add_text("only", " ".join(selection.only), hint="patterns of keys, like open-A-*")
        # A slider needs two ends.
        self._index: Any = gui.add_slider("sample", 0, max(1, len(self.view) - 1), 1, self.shown.index)
        key = self.view.images.location(self.shown.index)[1]
        self._key: Any = gui.add_text("key", key, hint="a sample's name, to go to it")
        step = gui.add_button_group("go to", ("previous", "next"))

        def choose(_: object) -> None:
            self.choose(split.value, where.value, only.value)

        for control in (split, where, only):
            control.on_update(choose)

        @self._index.on_update
        def _(_: object) -> None:
            with self._lock:
                index = min(int(self._index.value), len(self.view) - 1)
                self._key.value = self.view.images.location(index)[1]
            if index != self.shown.index:
                self.change(index=index)

        @step.on_click
        def _(_: object) -> None:
            self._index.value = (self.shown.index + (1 if step.value == "next" else -1)) % len(self.view)

        @self._key.on_update
        def _(_: object) -> None:
            key, here = self._key.value, min(int(self._index.value), len(self.view) - 1)
            index = here if key == self.view.images.location(here)[1] else self.view.index_of(key)
            if index is None:
                self.page.warn(f"no sample of those chosen has the key {self._key.value!r}")
            else:
                self._index.value = index

    def _add_image_controls(self) -> None:
        gui = self.page.server.gui
        variant = gui.add_dropdown("variant", (*VARIANTS, *PAIRS), initial_value=self.shown.variant)
        colourings = COLOURINGS if self.view.trained is not None else COLOURINGS[:2]
        colouring = gui.add_dropdown("colour by", colourings, initial_value=self.shown.colouring)
        epoch = gui.add_slider("draws of epoch", 0, 99, 1, self.shown.epoch)
        network = gui.add_checkbox("ask the network", self.shown.network, visible=self.view.trained is not None)

        variant.on_update(lambda _: self.change(variant=variant.value))
        colouring.on_update(lambda _: self.change(colouring=colouring.value))
        epoch.on_update(lambda _: self.change(epoch=epoch.value))
        network.on_update(lambda _: self.change(network=network.value))

    def _add_sensor_controls(self) -> None:
        gui = self.page.server.gui
        sensor = gui.add_dropdown("model", tuple(self._sensors), initial_value=self.shown.sensor.name)
        again = gui.add_button("Reset strengths")
        self._sensor = controls = SensorControls(self.page, self.shown.sensor, lambda model: self.change(sensor=model))

        def put(_: object) -> None:
            model = self._sensors[sensor.value]
            controls.put(model)
            self.change(sensor=model)

        sensor.on_update(put)
        again.on_click(put)


def _words(text: str) -> list[str]:
    """Words of a text as a shell divides it. Raises BadConfig for a quotation mark without its other one."""
    with reported(f"cannot divide {text!r} into words", BadConfig, ValueError):
        return shlex.split(text)
