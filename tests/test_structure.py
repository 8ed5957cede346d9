"""Rules about the code as a whole: which way imports point, what importing costs, what no file may say."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# The way data flows: a module may import only from lines above its own (docs/architecture.md).
ORDER = [
    "errors",
    "parts",
    "splits",
    "files",
    "machine",
    "system_libraries",
    "tables",
    "kernels",
    "randomness",
    "views",
    "rig",
    "connectivity",
    "mesh",
    "nearest_surface",
    "ply",
    "mesh_files",
    "mesh_repair",
    "mending",
    "landmarks",
    "landmark_points",
    "lnd",
    "landmark_files",
    "placing",
    "bodies",
    "proposal_surface",
    "proposal_body",
    "proposal_fit",
    "proposal",
    "borders",
    "geodesics",
    "partition",
    "sample",
    "artifacts",
    "rendering",
    "mesh_reduction",
    "codecs",
    "codec",
    "stores",
    "manifest",
    "addresses",
    "shards",
    "shard_cache",
    "cached_store",
    "packing_state",
    "packing",
    "engines",
    "variants",
    "batch_order",
    "streaming",
    "loading",
    "pictures",
    "portrait",
    "sheet",
    "gallery",
    "options",
    "charts",
    "benches",
    "commands",
    "cli",
]

MODEL_ORDER = [
    "range_input",
    "scores",
    "fcn_alexnet",
    "pretrained",
    "compact",
    "rivals",
    "crops",
    "networks",
    "checkpoints",
    "placements",
    "recipes",
    "objective",
    "optimisers",
    "ranks",
    "run_folder",
    "training",
    "mistakes",
    "border_distance",
    "calibration",
    "evaluation",
    "evaluation_report",
    "evaluation_figures",
    "evaluation_samples",
    "frame_times",
    "frame_png",
    "frame_tars",
    "frames",
    "cameras",
    "surfaces",
    "room_planes",
    "foreground",
    "resampling",
    "segmenter",
    "flicker",
    "overlay",
    "sequence_summary",
    "stability",
    "benches",
    "commands",
]

HEAVY = [
    "OpenGL",
    "anny",
    "distributed",
    "embreex",
    "matplotlib",
    "numba",
    "pygeodesic",
    "pymeshlab",
    "pyrender",
    "scipy",
    "sklearn",
    "tensorboard",
    "transformers",
    "trimesh",
    "warp",
]


def room(module: str) -> str:
    return module.split(".")[1]


def modules(package: str = "bodyseg_data") -> list[tuple[str, Path]]:
    files = sorted((ROOT / package).rglob("*.py"))
    return [(".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"), path) for path in files]


def imports(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module in ("bodyseg_data", "bodyseg_model"):
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert not node.level, "imports are absolute"
            found.add(node.module)
        elif isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
    return found


@pytest.mark.parametrize(("module", "path"), modules())
def test_imports_point_backwards_only(module: str, path: Path) -> None:
    if module in ("bodyseg_data", "bodyseg_data.__main__"):
        return  # the front door knows the whole house
    here = ORDER.index(room(module))
    for name in imports(path):
        assert not name.startswith("bodyseg_model"), f"{module} imports {name}: the data package knows no network"
        if name.startswith("bodyseg_data."):
            assert ORDER.index(room(name)) <= here, f"{module} imports {name}"


@pytest.mark.parametrize(("module", "path"), modules("bodyseg_model")[1:])
def test_imports_of_networks_point_backwards_only(module: str, path: Path) -> None:
    here = MODEL_ORDER.index(room(module))
    for name in imports(path):
        if name.startswith("bodyseg_model."):
            assert MODEL_ORDER.index(room(name)) <= here, f"{module} imports {name}"
        assert not name.startswith("bodyseg_data.commands.cli"), f"{module} imports {name}"


def test_an_import_against_the_flow_would_be_seen(tmp_path: Path) -> None:
    file = tmp_path / "x.py"
    file.write_text("from bodyseg_data import sheet, cli\nimport bodyseg_data.loading.range_images\n")
    assert imports(file) == {
        "bodyseg_data.drawing.contact_sheet",
        "bodyseg_data.commands.cli",
        "bodyseg_data.loading.range_images",
    }


def loaded_by(statement: str) -> list[str]:
    script = f"import sys; {statement}; print(*sorted({{name.partition('.')[0] for name in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60)
    return done.stdout.split()


def test_importing_the_package_is_light() -> None:
    loaded = loaded_by("import bodyseg_data")
    assert not {"torch", "numpy", *HEAVY} & set(loaded)


@pytest.mark.parametrize(
    "statement",
    [
        "from bodyseg_data import RangeImages, loader, load_rig, Augmentation",
        "import bodyseg_data.commands.inspect, bodyseg_data.commands.verify",
        "import bodyseg_data.bodies.source; bodyseg_data.bodies.sources.open_source('open').bodies()",
        "import bodyseg_data.packing.pack",
        "import bodyseg_model.commands.segment, bodyseg_model.commands.train, bodyseg_model.commands.evaluate",
        "import bodyseg_data.packing.engines.cluster, bodyseg_data.packing.engines.processes, bodyseg_data.commands.shard",
    ],
)
def test_streaming_and_planning_need_no_renderer(statement: str) -> None:
    assert not set(HEAVY) & set(loaded_by(statement))


def test_streaming_installs_no_renderer() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    core = {name.partition(">")[0].partition("=")[0] for name in project["dependencies"]}
    assert core == {"numpy", "torch", "webdataset", "zstandard", "pillow", "safetensors", "tqdm"}


def test_every_dependency_is_pinned_and_explained() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pinned = {line.partition("==")[0].lower() for line in (ROOT / "tools/requirements.lock").read_text().splitlines()}
    explained = (ROOT / "docs" / "dependencies.md").read_text()
    extras = [name for extra in project["optional-dependencies"].values() for name in extra if "bodyseg[" not in name]
    for needed in [*project["dependencies"], *extras]:
        name = needed.partition(">")[0].partition("=")[0].partition("[")[0]
        assert name.lower() in pinned
        assert f"`{name}`" in explained


def test_files_stay_small() -> None:
    long = {
        str(path): count
        for _, path in [*modules(), *modules("bodyseg_model")]
        if (count := len(path.read_text().splitlines())) > 310
    }
    assert not long
