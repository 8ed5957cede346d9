"""What a first user may get wrong about sets and loaders: refused at once, in one line, or done as meant."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from bodyseg_data import Mixture, RangeImages, loader
from bodyseg_data.artifacts import Augmentation
from bodyseg_data.core import BadConfig
from bodyseg_data.loading import CameraImage, WorkerLost
from bodyseg_data.loading.image_set import BatchOrder
from bodyseg_data.loading.workers import ProcessWorkers


def _open_files() -> int:
    """How many files this process has open, where a system tells."""
    return len(list(Path("/proc/self/fd").glob("*")))


ODD: tuple[Any, ...] = ("no", "", 1, 0, 1.5, [], object())


@pytest.fixture
def images(figures_set: Path) -> RangeImages:
    return RangeImages(figures_set, "all", split="train")


@pytest.mark.parametrize("path", [None, True, 3, 1.5, b"shards", [], {}, "", " ", "sh\0ards"])
def test_a_path_is_text_or_a_path(path: Any) -> None:
    with pytest.raises(BadConfig, match=r"^path must be that of a set, as text or a Path, found "):
        RangeImages(path)


@pytest.mark.parametrize(
    "path", ["none", "none/train-*.tar", "none/manifest.json", "/dev/null", "none/train-00000.tar"]
)
def test_a_folder_that_is_not_there_is_called_so(path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BadConfig, match=r"^no such folder: (none|/dev/null)$"):
        RangeImages(path)


@pytest.mark.parametrize("name", ["run [1]", "what?", "all*", "set.tar", "ünï ☃"])
def test_a_folder_may_be_called_anything(name: str, figures_set: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(figures_set, tmp_path / name)
    whole = RangeImages(figures_set)
    for path in (folder, f"{folder}/", folder / "manifest.json", f"{folder}/*.tar"):
        assert RangeImages(path).identity() == whole.identity()


def test_a_program_may_change_its_folder(figures_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers that are no forks start in the folder in which the program was started."""
    monkeypatch.chdir(figures_set.parent)
    images = RangeImages(figures_set.name, "none", split="test")
    monkeypatch.chdir("/")
    batches = loader(images, 4, num_workers=1, worker_method="process", start_method="forkserver")
    assert images.path == figures_set.name
    assert sum(len(batch["key"]) for batch in batches) == len(images)


@pytest.mark.parametrize("option", ["shuffle", "drop_last", "metres", "pin_memory"])
def test_text_is_no_yes_or_no(images: RangeImages, option: str) -> None:
    for value in ODD:
        more = ", False or 'blocks'" if option == "shuffle" else " or False"
        with pytest.raises(BadConfig, match=f"^{option} must be True{more}, found "):
            loader(images, 4, **{option: value})
    assert len(loader(images, 4, **{option: np.bool_(False)})) == len(loader(images, 4))


@pytest.mark.parametrize("value", [None, "shards", 3])
def test_a_loader_needs_images(value: Any) -> None:
    with pytest.raises(BadConfig, match=r"^images must be RangeImages or a Mixture, found (NoneType|str|int)$"):
        loader(value, 4)


def test_an_index_is_a_whole_number_within_the_set(images: RangeImages) -> None:
    items = images.__getitem__, Mixture([(images, 1)]).__getitem__
    ways: tuple[Callable[[Any], Any], ...] = (*items, images.image, images.clean, images.location)
    for way in ways:
        for value in (None, "0", 1.0, [0], slice(0, 2), (0,), (0, 1, 2)):
            with pytest.raises(BadConfig, match=r"^a sample's index must be a whole number, found "):
                way(value)
        for value in (len(images), -len(images) - 1, 10**30):
            with pytest.raises(IndexError, match=rf"^index {value} of {len(images)} samples$"):
                way(value)
    assert (
        images.location(-1)
        == images.location(np.int64(len(images) - 1))
        == images.location(torch.tensor(len(images) - 1))
    )


def test_an_order_is_the_one_asked_for(images: RangeImages) -> None:
    """Not that by blocks for whatever is not Python's own bool."""
    mixture: Any = Mixture([(images, 1)])
    for value in ("block", None, 0, 1):
        for way in (images.order, images.requests, mixture.requests):
            with pytest.raises(BadConfig, match="^shuffle must be True, False or 'blocks', found "):
                way(0, value)
    no: Any = np.bool_(False)
    np.testing.assert_array_equal(images.order(0, no), np.arange(len(images)))


@pytest.mark.parametrize("epoch", [-1, True, "1", 1.0])
def test_an_epoch_is_checked_wherever_it_is_taken(images: RangeImages, epoch: Any) -> None:
    ways: tuple[Callable[[], Any], ...] = (
        lambda: images.order(epoch),
        lambda: images.image(0, epoch),
        lambda: images.augmentation(images.clean(0), epoch),
    )
    for way in ways:
        with pytest.raises(BadConfig, match="^an epoch must be a whole number of at least 0, found "):
            way()


def test_an_augmentation_needs_a_rig_and_a_sensor(images: RangeImages) -> None:
    rig: Any = images.manifest.rig
    nothing: Any = None
    with pytest.raises(BadConfig, match="^Augmentation: rig must be of class Rig, found None$"):
        Augmentation(nothing, "all")
    with pytest.raises(BadConfig, match="^Augmentation: sensor must be of class SensorModel, found None$"):
        Augmentation(rig, "all", 0, nothing)


def test_an_epoch_of_nothing_is_refused(images: RangeImages) -> None:
    size = len(images) + 1
    with pytest.raises(
        BadConfig, match=rf"^{len(images)} samples are too few: .* one batch of {size}, and .*drop_last=True"
    ):
        loader(images, size, drop_last=True)
    with pytest.raises(BadConfig, match=r"do not fill one batch of \d+ on each of 2 ranks,.* a smaller batch_size$"):
        loader(images, len(images) // 2 + 1, drop_last=True, rank=0, world_size=2)
    assert len(loader(images, len(images), drop_last=True)) == 1


def test_more_than_there_is_takes_no_more_than_there_is(images: RangeImages) -> None:
    """A batch, prefetch factor or number of workers larger than the set costs what the set costs."""
    batches = loader(
        images, 10**30, num_workers=10**30, prefetch_factor=10**30, worker_method="process", start_method="fork"
    )
    passed = list(batches)
    assert [len(batch["key"]) for batch in passed] == [len(images)]
    state = batches._state
    assert state is not None and isinstance(state.workers, ProcessWorkers) and len(state.workers._processes) == 1
    assert state.slots.arrays(0)[0].shape[0] == len(images) and state.slots._count == 4


@pytest.mark.parametrize(("samples", "size", "ranks"), [(7, 3, 2), (7, 10, 2), (5, 5, 5), (9, 2, 4)])
def test_the_largest_batch(samples: int, size: int, ranks: int, figures_set: Path) -> None:
    keys = RangeImages(figures_set, "all", "train").keys[:samples]
    images = RangeImages(figures_set, "all", "train", only=keys)
    orders = [BatchOrder(images, size, rank=rank, world_size=ranks) for rank in range(ranks)]
    assert max(len(batch) for order in orders for batch in order) <= orders[0].largest <= size


def test_ranks_of_numpy_leave_states_that_are_plain_json(figures_set: Path) -> None:
    keys = RangeImages(figures_set, "all", "train").keys[:9]
    images = RangeImages(figures_set, "all", "train", only=keys)
    order = BatchOrder(images, 2, rank=np.int64(1), world_size=np.int64(4))  # type: ignore[arg-type]
    next(iter(order))
    state = json.loads(json.dumps(order.state_dict()))
    assert state["position"] == 5, "the last batch has four samples, one a rank"
    order.load_state_dict(state)


def test_workers_that_cannot_start(images: RangeImages, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_more() -> Any:
        raise OSError(24, "Too many open files")

    before = _open_files()
    monkeypatch.setattr("multiprocessing.popen_fork.os.pipe", no_more)
    with pytest.raises(
        WorkerLost, match="^worker 0 of 2 could not be started: Too many open files; use fewer workers$"
    ):
        list(loader(images, 4, num_workers=2, worker_method="process", start_method="fork"))
    assert _open_files() == before


@pytest.fixture
def main_module(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """An empty module in the place of that which Python was started with: workers that are no forks import its file."""
    module = ModuleType("__main__")
    monkeypatch.setitem(sys.modules, "__main__", module)
    return module


BEGINNING = """
from bodyseg_data import RangeImages, loader
options = {"num_workers": 1, "worker_method": "process", "start_method": "forkserver"}
"""


def test_a_script_without_a_guard_is_told_so(figures_set: Path, tmp_path: Path, main_module: ModuleType) -> None:
    script = tmp_path / "script.py"
    script.write_text(f"{BEGINNING}list(loader(RangeImages({str(figures_set)!r}, 'none'), 4, **options))\n")
    main_module.__file__ = str(script)
    with pytest.raises(WorkerLost, match='needs `if __name__ == "__main__":` with this start method'):
        exec(script.read_text(), vars(main_module))


def test_a_transform_of_a_cell_is_said_to_be_one(figures_set: Path, main_module: ModuleType) -> None:
    """As in a notebook, there is no file that a worker could import the transform from."""
    exec(f"{BEGINNING}def mine(image):\n    return image\n", vars(main_module))
    images = RangeImages(figures_set, "none", transform=main_module.mine)
    message = r"cannot be unpickled in a worker: AttributeError: .*'mine'.* must be in a module, .*, a notebook's cell"
    with pytest.raises(WorkerLost, match=message) as caught:
        list(loader(images, 4, **main_module.options))
    assert "__name__ ==" not in str(caught.value)


@pytest.mark.parametrize("start_method", ["spawn", "forkserver"])
def test_a_transform_of_a_function_is_said_to_be_one(figures_set: Path, start_method: Any) -> None:
    def mine(image: CameraImage) -> CameraImage:
        return image

    options = {"num_workers": 1, "worker_method": "process", "start_method": start_method}
    with pytest.raises(BadConfig, match=r"^the images cannot be pickled for a worker: .*mine.*worker_method='thread'"):
        next(iter(loader(RangeImages(figures_set, transform=mine), 4, **options)))


def test_memory_that_cannot_be_had(images: RangeImages, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(file: int, size: int) -> None:
        raise OSError(12, "Cannot allocate memory")

    monkeypatch.setattr(os, "ftruncate", full)
    with pytest.raises(BadConfig, match=r"^4 batches of 3 samples take 0\.0 GB, which cannot be allocated: Cannot"):
        list(loader(images, 3))
