"""Fixtures that several test files share, and the order of the files."""

from __future__ import annotations

import gc
import multiprocessing
import os
import sys
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import checked_arrays  # noqa: F401  # checks the arrays of all that is imported from here on
import hypothesis
import pytest
import shared_anny  # noqa: F401  # before anything imports what loads the body model
import shared_distances  # noqa: F401
from fakes import Figures
from folders import SHARED_DATA, TESTS
from kernel_forms import FORMS, computed_by
from small_rig import SMALL

from bodyseg_data.bodies import SOURCES
from bodyseg_data.commands import shard
from bodyseg_data.core import MissingLibrary
from bodyseg_data.machine.kernels import VARIABLE
from bodyseg_data.meshes import GeodesicMethod, with_pymeshlab
from bodyseg_data.meshes import partitioning as surface_parts
from bodyseg_data.meshes.geodesics import nearest_sources
from bodyseg_data.packing import Packing, pack
from bodyseg_data.packing.jobs import Engine
from bodyseg_data.rigs import Rig, load_rig
from bodyseg_data.samples import ViewGrid

# Processes of a fork server, the way of multiprocessing's three that tests choose unless they are about another one,
# are then as quick to start as forks, and have nothing of the tests' process.
multiprocessing.set_forkserver_preload(["bodyseg_data.loading.range_images", "bodyseg_data.loading.workers", "numba"])

# Nothing imports pymeshlab (GPL-3.0) by default: where a test does not ask for it by the fixture, importing it fails.
sys.modules["pymeshlab"] = None  # type: ignore[assignment]

# Tests of compiled loops wait for the compiler.
os.environ.setdefault(VARIABLE, "compiled")

# No test depends on how busy the machine is. Examples are others in every run.
hypothesis.settings.register_profile(
    "untimed", max_examples=25, deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("untimed")

_LONG_FILES: Final = (
    "benches/results/test_running.py",
    "packing/test_engines.py",
    "loading/test_loader_faults.py",
    "benches/landmarks/test_landmark_fitting.py",
    "shards/test_stores.py",
    "benches/fuzzing/test_fuzz.py",
    "test_tutorial.py",
    "benches/model/test_people.py",
    "packing/test_pack.py",
    "benches/model/test_real.py",
    "benches/data/test_loader.py",
    "benches/data/test_workers.py",
    "bodies/sources/test_everyday.py",
    "test_code_blocks.py",
    "evaluation/test_evaluation.py",
    "artifacts/test_occlusion.py",
    "bodies/test_motions.py",
    "benches/results/test_everything.py",
    "segmentation/test_segment_command.py",
    "commands/test_cli.py",
    "benches/model/test_variants.py",
    "loading/test_arguments.py",
    "benches/model/test_rooms.py",
    "rendering/test_missing.py",
    "meshes/test_pymeshlab_thread.py",
    "runtimes/test_runtimes.py",
    "benches/model/test_runtimes.py",
    "bodies/sources/test_open_bodies.py",
    "packing/test_mesh_reduction.py",
    "loading/test_look_ahead.py",
    "renders/test_mistakes.py",
    "test_your_renders.py",
    "training/test_loop.py",
    "packing/test_pack_faults.py",
    "bodies/test_clothes.py",
    "machine/test_kernels.py",
    "test_notebooks.py",
    "test_structure.py",
    "loading/test_worker_threads.py",
    "packing/test_two_projectors.py",
    "rendering/test_views.py",
    "segmentation/test_turned.py",
    "benches/data/test_reduction.py",
    "benches/model/test_ablation.py",
    "training/test_torchrun.py",
    "packing/test_faulty_meshes.py",
    "loading/test_loader.py",
    "packing/test_sampler.py",
    "benches/model/test_segment.py",
    "packing/test_template.py",
    "benches/data/test_render.py",
    "benches/landmarks/test_body_views.py",
    "test_install.py",
    "networks/test_own_network.py",
    "packing/test_shadow_thresholds.py",
    "transfer/test_transfer.py",
    "training/test_train_command.py",
    "benches/model/test_everyday.py",
    "benches/results/test_chart_command.py",
    "commands/test_own_classes.py",
    "shards/test_sample_codec.py",
)
"""Files that take longest, which start first: at the end of `make test`, short ones keep both processors at work."""

_ABSENT: Final = "shared data are absent"
"""How the reason begins for which tests without them are skipped."""


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    order = {TESTS / name: index for index, name in enumerate(_LONG_FILES)}
    items.sort(key=lambda item: order.get(item.path, len(order)))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, Any, Any]:
    """Without garbage collections: modules and tests, and later what is there by now, garbage too, stay to the end.

    Later, too, garbage is looked for less often than usual: tests that depend on that collect it themselves.
    """
    gc.set_threshold(50_000, 20, 20)
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.fixture(params=FORMS)
def either_form(request: pytest.FixtureRequest) -> Iterator[None]:
    """The test is run once by the compiled loops, and once by NumPy's forms of them."""
    with computed_by(request.param):
        yield


@pytest.fixture
def one_thread() -> Iterator[None]:
    """One thread of PyTorch: small images are no work for two."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def near_is_person(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is nearer than 3.5 m is a person, for whoever asks the finder that ships."""
    from label_networks import Nearer

    from bodyseg_model.networks import Trained
    from bodyseg_model.segmentation import finder, frame_labeller, segmenter

    for module in (finder, frame_labeller, segmenter):
        monkeypatch.setattr(module, "shipped_finder", lambda: Trained(Nearer(), {"weights_sha256": "1"}))


@pytest.fixture
def prepared(monkeypatch: pytest.MonkeyPatch) -> list[Rig]:
    """Rigs that segmenters were prepared for, whose usual views are left out: they take longer than a few frames."""
    from bodyseg_model.segmentation import segmenter

    rigs: list[Rig] = []
    monkeypatch.setattr(segmenter, "usual_views", lambda rig, together: rigs.append(rig) or [])
    return rigs


@pytest.fixture(scope="session")
def shared_data() -> Callable[[str], Path]:
    """Give a folder of bodies or frames whose licences keep them out of the repository, as "real/kinect_v1".

    A test that needs one skips here and nowhere else where it is absent; `pytest_terminal_summary` counts these tests.
    """

    def folder_of(name: str) -> Path:
        if not (SHARED_DATA / name).is_dir():
            pytest.skip(f"{_ABSENT}: {SHARED_DATA} lacks {name}")
        return SHARED_DATA / name

    return folder_of


@pytest.fixture(scope="session")
def mit_folder(shared_data: Callable[[str], Path]) -> Path:
    """The folder of real MIT frames."""
    return shared_data("mit/I_crane").parent


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Say how many tests were skipped for want of data that are not in the repository."""
    reports = terminalreporter.stats.get("skipped", [])
    count = sum(isinstance(report.longrepr, tuple) and _ABSENT in report.longrepr[2] for report in reports)
    if count:
        terminalreporter.write_line(
            f"{count} tests were skipped for want of shared data: give their folder as BODYSEG_SHARED_DATA "
            f"(now {SHARED_DATA})",
            yellow=True,
        )


@pytest.fixture(scope="session")
def _loaded_pymeshlab() -> Any:
    """The package, loaded once a process, or the line that says why it cannot be."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delitem(sys.modules, "pymeshlab")
        try:
            return with_pymeshlab("these tests", lambda module: module)
        except MissingLibrary as error:
            return str(error)


@pytest.fixture(scope="module")
def pymeshlab(_loaded_pymeshlab: Any) -> Iterator[Any]:
    """The package, which can be imported from here to the end of the file of tests."""
    if isinstance(_loaded_pymeshlab, str):
        pytest.skip(_loaded_pymeshlab)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "pymeshlab", _loaded_pymeshlab)
        yield _loaded_pymeshlab


@pytest.fixture(scope="session")
def pack_figures() -> Callable[..., Path]:
    """Pack the plain figures of `fakes` into a folder, in this process and as the small rig sees them.

    executor: what renders, if not a thread. options: those of a packing.
    """

    def pack_into(out: Path, executor: Executor | None = None, **options: Any) -> Path:
        wanted = {"views": ViewGrid(span_deg=360, count=4), "rig": SMALL, **options}
        with pytest.MonkeyPatch.context() as patch, ThreadPoolExecutor(1) as thread:
            patch.setitem(SOURCES, "open", Figures)
            pack(Packing("open", **wanted), out, executor or thread, 1)
        return out

    return pack_into


@pytest.fixture(scope="module")
def quick_geodesics() -> Iterator[None]:
    """Let exact distances along surfaces be those along edges, for tests whose rules hold for parts of any shape.

    A body's exact ones take a third of a second of processor, the others a tenth of that.
    """

    def along_edges(method: GeodesicMethod, *surface: Any) -> Any:
        return nearest_sources("edges" if method == "exact" else method, *surface)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surface_parts, "nearest_sources", along_edges)
        yield


@pytest.fixture
def packing_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `bodyseg shard` render in a thread of this process: processes of its own load the body model each anew."""

    @contextmanager
    def engine_here(name: str, workers: int | None, packing: Packing) -> Iterator[Engine]:
        with ThreadPoolExecutor(1) as thread:
            yield Engine(thread, 1)

    monkeypatch.setattr(shard, "open_engine", engine_here)


@pytest.fixture(scope="session")
def figures_set(tmp_path_factory: pytest.TempPathFactory, pack_figures: Callable[..., Path]) -> Path:
    """A set of 24 samples (16 train, 8 test) in shards of 5. Tests must not change it."""
    return pack_figures(tmp_path_factory.mktemp("figures") / "shards", shard_samples=5)


@pytest.fixture(scope="session")
def small_set(tmp_path_factory: pytest.TempPathFactory, pack_figures: Callable[..., Path]) -> Path:
    """The same samples in shards of 8. Tests must not change it."""
    return pack_figures(tmp_path_factory.mktemp("small") / "shards", shard_samples=8)


@pytest.fixture(scope="session")
def paper_set(tmp_path_factory: pytest.TempPathFactory, pack_figures: Callable[..., Path]) -> Path:
    """The samples of `figures_set` as the paper's rig sees them: 16 times the pixels. Tests must not change it."""
    return pack_figures(tmp_path_factory.mktemp("paper") / "shards", rig=load_rig(), shard_samples=5)
