"""Networks in files: weights as safetensors, all else as JSON beside them. No pickle; nothing in a file is run."""

import contextlib
import hashlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from threading import get_ident
from types import NoneType
from typing import Any, ClassVar, Final

import torch
from safetensors import SafetensorError
from safetensors.torch import load as parse_tensors
from safetensors.torch import save as tensor_bytes
from torch import nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from bodyseg_data.artifacts import SensorModel, load_sensor_model, sensor_model_from_json
from bodyseg_data.core import BadConfig, check_class, reported
from bodyseg_data.files import parts_left, read_bytes, read_json, write_json, write_result
from bodyseg_data.labels import PARTS33, LabelClass, LabelMap, classes_of, label_map_from_json, whole_map
from bodyseg_data.rigs import Rig, load_rig, rig_from_json
from bodyseg_model.networks.names import CardWords, RunFiles
from bodyseg_model.networks.network import Network, WrappedModule, check_label_map
from bodyseg_model.networks.registry import build

SHIPPED: Final = Path(__file__).parents[1] / "weights" / "compact.safetensors"
"""Of the quick network that labels bodies."""

LARGE: Final = SHIPPED.with_name("large.safetensors")
"""Of a more accurate one, which takes longer."""

PLACES: Final = SHIPPED.with_name("compact_places.safetensors")
"""Of its head of places; the settings in the card are those of both together."""

FINDER: Final = SHIPPED.with_name("finder.safetensors")
"""Of the network that finds people in rooms, whose classes are those of the label map "people"."""

_NAMED: Final = {file.stem: file for file in (SHIPPED, LARGE, FINDER)}
"""Name -> file of a network that ships, which may be given instead of a path."""


@dataclass(frozen=True)
class Trained:
    """A network in evaluation mode with its card: name, settings, and how and on what it was trained.

    label_map: the classes that it predicts; the 33 parts where the card does not name them. rig: camera, projector and
    stand-off of the images that it was trained on. sensor: the artifacts of these images, before the variant took those
    of its kinds. Rig and sensor are the paper's where the card does not name them.
    """

    network: Network
    card: dict[str, Any]

    @cached_property
    def label_map(self) -> LabelMap:
        """The card's label map. Raises BadConfig for an entry that is none."""
        return label_map_from_json(self.card["labels"], "labels") if "labels" in self.card else PARTS33

    @cached_property
    def rig(self) -> Rig:
        """The card's rig. Raises BadConfig for an entry that is none."""
        return rig_from_json(self.card["rig"]) if "rig" in self.card else load_rig()

    @cached_property
    def sensor(self) -> SensorModel:
        """The card's sensor model. Raises BadConfig for an entry that is none, or an artifact that is not installed."""
        if "sensor" not in self.card:
            return load_sensor_model()
        return sensor_model_from_json(self.card["sensor"], "a network's card, sensor")

    def __repr__(self) -> str:
        facts = {name: self.card.get(name) for name in ("network", "settings", "variant", "seed")}
        return f"Trained({', '.join(f'{name}={value!r}' for name, value in facts.items())})"


@dataclass(frozen=True)
class Checkpoint:
    """State of a training after `step` steps. loader_state: `Loader.state_dict`.

    tensors: the network's weights as "network.NAME", their averages, if there are any, as "average.NAME", those that
    the training started from, if it saves a share of them, as "start.NAME", and the optimiser's state as
    "optimiser.NAME". sha256: of the file of tensors that it was read from, None for a new one.
    """

    step: int
    loader_state: dict[str, Any]
    tensors: dict[str, torch.Tensor]
    sha256: str | None = None

    TRAINED: ClassVar = "network."
    AVERAGED: ClassVar = "average."
    START: ClassVar = "start."

    @property
    def file(self) -> str:
        """Name of the file that holds the tensors."""
        return f"checkpoint-{self.step:08d}.safetensors"

    def write(self, folder: Path) -> None:
        """Write this to a run's folder, and delete the one before when this one is complete. Raises BadConfig."""
        digest = write_tensors(folder / self.file, self.tensors)
        note = {"step": self.step, "loader_state": self.loader_state, "tensors": self.file, "sha256": digest}
        write_json(folder / RunFiles.CHECKPOINT, note)
        for old in (*folder.glob(f"checkpoint-{'[0-9]' * 8}.safetensors"), *parts_left(folder)):
            if old.name != self.file:
                with contextlib.suppress(OSError):
                    old.unlink()

    def part(self, prefix: str) -> dict[str, torch.Tensor]:
        """The tensors whose names begin with `prefix`, without it."""
        return {name.removeprefix(prefix): t for name, t in self.tensors.items() if name.startswith(prefix)}

    @staticmethod
    def mean(weights: Mapping[str, torch.Tensor], start: Mapping[str, torch.Tensor], share: float) -> dict[str, Any]:
        """The mean of trained weights and those at the start, which have this share; whole numbers as trained."""
        return {name: t.lerp(start[name], share) if t.is_floating_point() else t for name, t in weights.items()}


def save_network(path: Path, network: Network, name: str, facts: Mapping[str, Any], half: bool = False) -> None:
    """Write weights to `path` (.safetensors) and the card beside it, the card last. Raises BadConfig, also for a file
    of the card's name that is no card.

    facts: further entries of the card, which also gets the weights' SHA-256. half: filters in 16 bits, for half the
    bytes; scales, biases and statistics stay in 32.
    """
    if path.with_suffix(".json").exists():
        with reported(f"{path} has its card beside it", BadConfig):
            read_card(path)  # raises for a file of the user
    card = {"format": CardWords.FORMAT, "network": name, "settings": network.settings, **facts}
    card[CardWords.WEIGHTS_SHA256] = write_tensors(path, half_weights(network) if half else network.state_dict())
    write_json(path.with_suffix(".json"), card)


def half_weights(network: Network) -> dict[str, torch.Tensor]:
    """Weights of a network with the filters in 16 bits; scales, biases and statistics stay in 32."""
    return {name: weight.half() if weight.ndim > 1 else weight for name, weight in network.state_dict().items()}


def load_network(path: Path | str | None = None, *, dense: bool = False) -> Trained:
    """Load the network of a run's folder or .safetensors file; `load_network` reads .onnx, too. Raises BadConfig."""
    path = SHIPPED if path is None else Path(path)
    path = path if path.exists() else _NAMED.get(str(path), path)
    if path.is_dir() and RunFiles.unfinished(path):
        return _last_weights(path)
    file = path / RunFiles.NETWORK if path.is_dir() else path
    if file.suffix != ".safetensors" or not path.exists():
        found = path if path.exists() else f"{path}, which is not there"
        raise BadConfig(f"a network is {', '.join(_NAMED)}, a run's folder or a .safetensors file, found {found}")
    card = read_card(file)
    tensors, digest = _read_weights(file, card)
    if dense and file == SHIPPED:
        of_head = read_card(PLACES)
        tensors |= _read_weights(PLACES, of_head)[0]
        card = {**card, "settings": of_head["settings"]}
    network = _build(card, file.with_suffix(".json"), tensors)
    fill(network, tensors, file)
    return trained_network(network, {**card, CardWords.WEIGHTS_SHA256: digest}, file.with_suffix(".json"))


def _read_weights(file: Path, facts: Mapping[str, Any]) -> tuple[dict[str, torch.Tensor], str]:
    """Tensors of a file and its SHA-256. Raises BadConfig if `facts` name another SHA-256."""
    data, expected = read_bytes(file), facts.get(CardWords.WEIGHTS_SHA256)
    digest = hashlib.sha256(data).hexdigest()
    if expected not in (None, digest):
        raise BadConfig(f"{file} is damaged or not the file of its card: SHA-256 {digest}, expected {expected}")
    return _parse(data, file), digest


def check_trained(trained: object) -> None:
    """Raise BadConfig for what is no network with its card, as a network alone is not."""
    if not isinstance(trained, Trained):
        what = "a network with its card is needed, as load_network(...) and wrapped(module) give it"
        raise BadConfig(f"{what}, found {type(trained).__name__}")


def wrapped(
    module: nn.Module,
    labels: LabelMap | Iterable[str | LabelClass] = PARTS33,
    *,
    rig: Rig | None = None,
    prepare: Callable[[torch.Tensor], torch.Tensor] | None = None,
    multiple: int = 1,
) -> Trained:
    """Wrap a torch module of your own as a `Trained`, which `FrameLabeller`, `Segmenter` and `write_onnx` take;
    `evaluate` and `predict` take its `network`.

    module: range images, float32 [B, 1, H, W], metres along the optical axis, 0 = nothing measured, of any size ->
    scores (logits), float [B, C, H, W]. It is put into evaluation mode, and stays on its device.
    labels: its C classes in their order, as names or a label map.
    rig: of the images that it was trained on, to which bodies are resampled; None for the paper's.
    prepare: makes the module's input of range images, where it takes other units, normalised ranges or more channels.
    multiple: range images are padded by 0 until both sides are multiples of it.
    Raises BadConfig; for scores of another shape, as soon as they are asked for.
    """
    if not isinstance(module, nn.Module) or isinstance(module, Network):
        raise BadConfig(f"what is wrapped must be a torch module and no Network, found {type(module).__name__}")
    check_class("rig", rig, Rig, NoneType)
    label_map = labels if isinstance(labels, LabelMap) else whole_map(classes_of(labels))
    card = {"format": CardWords.FORMAT, "network": type(module).__name__, "settings": {}, "labels": label_map.to_json()}
    card["rig"] = (load_rig() if rig is None else rig).to_json()
    return Trained(WrappedModule(module, len(label_map), prepare, multiple).eval(), card)


def read_card(weights: Path) -> dict[str, Any]:
    """Read the card beside weights (.safetensors). Raises BadConfig, naming it, also for one of another format."""
    file = weights.with_suffix(".json")
    card = read_json(file)
    if card.get("format") != CardWords.FORMAT:
        raise BadConfig(f"{file}: the format must be {CardWords.FORMAT!r}, found {card.get('format')!r}")
    return card


def _build(card: dict[str, Any], where: Path, held: Mapping[str, torch.Tensor]) -> Network:
    """A network as a card or a plan describes it. Raises BadConfig, also for one with far more weights than `held`."""
    name, settings = card.get("network"), card.get("settings")
    if not isinstance(name, str) or not isinstance(settings, dict):
        raise BadConfig(f"{where} must name the network and its settings")
    left, thread = (1 << 20) + 2 * sum(tensor.numel() for tensor in held.values()), get_ident()

    def count(_module: torch.nn.Module, _name: str, weights: torch.nn.Parameter) -> None:
        nonlocal left
        left -= weights.numel() if get_ident() == thread else 0
        if left < 0:
            raise BadConfig("the network must fit its weights, found a larger one")

    hook = register_module_parameter_registration_hook(count)
    try:
        with reported(str(where), BadConfig), torch.random.fork_rng([]):  # the caller's random numbers go on
            return build(name, settings).to("cpu", torch.float32)  # whatever torch's defaults are
    finally:
        hook.remove()


def trained_network(network: Network, card: dict[str, Any], where: Path) -> Trained:
    """A network in evaluation mode with its card, whose classes and rig are checked. where: the card's file.

    Raises BadConfig, naming the file, for other classes than the network's, or an entry that is no rig.
    """
    trained = Trained(network.eval(), card)
    with reported(str(where), BadConfig):  # here, where the file is known
        check_label_map(network, trained.label_map)
        _ = trained.rig
    return trained


def fill(network: Network, tensors: Mapping[str, torch.Tensor], file: Path) -> None:
    """Put weights read from `file` into a network. Raises BadConfig where a name, shape or kind does not fit."""
    expected = network.state_dict()
    for name in sorted(expected.keys() ^ tensors.keys()):
        raise BadConfig(f"{file} {'lacks' if name in expected else 'has no use for'} the weights {name!r}")
    for name, weight in expected.items():
        found = tensors[name]
        halved = found.dtype == torch.float16 and weight.dtype == torch.float32
        if found.shape != weight.shape or not (halved or found.dtype == weight.dtype):
            raise BadConfig(
                f"{file}: {name!r} must be {weight.dtype} {list(weight.shape)}, found {found.dtype} {list(found.shape)}"
            )
        if not torch.isfinite(found).all():
            raise BadConfig(f"{file}: {name!r} holds numbers that are not finite")
    network.load_state_dict(dict(tensors))


def read_checkpoint(folder: Path) -> Checkpoint | None:
    """Read a run's last checkpoint, also while it trains; None if there is none yet. Raises BadConfig if damaged."""
    file = folder / RunFiles.CHECKPOINT
    if not file.exists():
        return None
    note = read_json(file)
    name, digest, step, state = (note.get(key) for key in ("tensors", "sha256", "step", "loader_state"))
    if not isinstance(step, int) or not isinstance(state, dict) or name != Checkpoint(step, state, {}).file:
        raise BadConfig(f"{file} must hold the step, loader_state and tensors of a checkpoint")
    try:
        data = read_bytes(folder / name)
    except BadConfig:
        if read_json(file) == note:
            raise
        return read_checkpoint(folder)  # the training has replaced it meanwhile
    found = hashlib.sha256(data).hexdigest()
    if found != digest:
        raise BadConfig(f"{folder / name} is damaged: SHA-256 {found}, expected {digest}")
    return Checkpoint(step, state, _parse(data, folder / name), found)


def _last_weights(folder: Path) -> Trained:
    """Load the weights of a run's last checkpoint as the training would save them, with its plan as card."""
    checkpoint = read_checkpoint(folder)
    if checkpoint is None:
        raise BadConfig(f"{folder} has no checkpoint yet")
    plan = read_json(folder / RunFiles.PLAN)
    network = _build(plan, folder / RunFiles.PLAN, checkpoint.tensors)
    weights = checkpoint.part(Checkpoint.AVERAGED) or checkpoint.part(Checkpoint.TRAINED)
    if start := checkpoint.part(Checkpoint.START):
        weights = Checkpoint.mean(weights, start, plan["recipe"]["start_share"])
    fill(network, weights, folder / checkpoint.file)
    steps = {"step": checkpoint.step, "last_step": checkpoint.step}
    card = {**plan, "format": CardWords.FORMAT, **steps, CardWords.WEIGHTS_SHA256: checkpoint.sha256}
    return trained_network(network, card, folder / RunFiles.PLAN)


def write_tensors(path: Path, tensors: Mapping[str, torch.Tensor]) -> str:
    """Write tensors as safetensors, at once or not at all; returns the SHA-256 of the file. Raises BadConfig."""
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    data = tensor_bytes(plain)
    write_result(path, data)
    return hashlib.sha256(data).hexdigest()


def _parse(data: bytes, path: Path) -> dict[str, torch.Tensor]:
    with reported(f"{path} is not a whole safetensors file", BadConfig, SafetensorError):
        return parse_tensors(data)
