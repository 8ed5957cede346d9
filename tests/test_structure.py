"""Rules about the code as a whole: which way imports point, what importing costs, what no file may say."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]

PACKAGES = ("bodyseg_data", "bodyseg_model", "benches")
"""In the order in which they may import: each from those before it and from itself."""

HEAVY = [
    "OpenGL",
    "anny",
    "av",
    "distributed",
    "embreex",
    "matplotlib",
    "mcap",
    "numba",
    "pygeodesic",
    "pymeshlab",
    "pyrender",
    "rosbags",
    "scipy",
    "skimage",
    "sklearn",
    "tensorboard",
    "transformers",
    "trimesh",
    "warp",
]


def listed_rooms() -> list[str]:
    """The rooms in the order that docs/explanation/architecture.md gives: a room imports only from those above it."""
    text = (ROOT / "docs" / "explanation" / "architecture.md").read_text()
    (block,) = re.findall(r"```rooms\n(.*?)```", text, re.DOTALL)
    rooms, package = [], ""
    for line in block.splitlines():
        name = line.split()[0].rstrip("/").removesuffix(".py")
        if line.startswith(" "):
            rooms.append(f"{package}.{name}")
        else:
            package = name.removeprefix("tools/")
    return rooms


def modules() -> dict[str, Path]:
    """Name -> file of every module of the project, tests aside."""
    homes = [ROOT, ROOT, ROOT / "tools"]
    found = {}
    for home, package in zip(homes, PACKAGES, strict=True):
        for path in sorted((home / package).rglob("*.py")):
            found[".".join(path.relative_to(home).with_suffix("").parts).removesuffix(".__init__")] = path
    return found


def imports(text: str, known: set[str]) -> set[str]:
    """The project's modules that a module's text imports, or names in a string that is a module's dotted name."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom):
            assert node.module and not node.level, "imports are absolute"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                found.add(whole if whole in known else node.module)
        elif isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.add(node.value)
    return found & known


def faults(sources: dict[str, str], rooms: list[str]) -> list[str]:
    """Imports against the order of the rooms, one line each; a package's front door may import all of its own."""
    known = set(sources)
    lines = []
    for module, text in sources.items():
        package, _, rest = module.partition(".")
        front_door = rest in ("", "__main__")
        here = None if front_door else ".".join(module.split(".")[:2])
        if here is not None and here not in rooms:
            lines.append(f"{module} is in no room")
            continue
        for name in sorted(imports(text, known)):
            there = ".".join(name.split(".")[:2])
            if there.partition(".")[0] == there:  # a package itself: its public names
                if PACKAGES.index(there) > PACKAGES.index(package):
                    lines.append(f"{module} imports {name}")
            elif front_door:
                if PACKAGES.index(there.partition(".")[0]) > PACKAGES.index(package):
                    lines.append(f"{module} imports {name}")
            elif here is not None and rooms.index(there) > rooms.index(here):
                lines.append(f"{module} imports {name}")
    return lines


def test_rooms_import_only_from_rooms_above_them() -> None:
    assert not faults({name: path.read_text() for name, path in modules().items()}, listed_rooms())


def test_an_import_against_the_order_is_seen() -> None:
    sources = {
        "bodyseg_data": "",
        "bodyseg_data.core.rig": "from bodyseg_data.loading import loader",
        "bodyseg_data.loading.loader": "import bodyseg_data.core.rig",
        "bodyseg_data.loose": "",
        "bodyseg_data.commands.cli": "TABLE = {'train': 'bodyseg_model.commands.train'}",
        "bodyseg_model.commands.train": "import bodyseg_data",
    }
    rooms = ["bodyseg_data.core", "bodyseg_data.loading", "bodyseg_data.commands", "bodyseg_model.commands"]
    assert faults(sources, rooms) == [
        "bodyseg_data.core.rig imports bodyseg_data.loading.loader",
        "bodyseg_data.loose is in no room",
        "bodyseg_data.commands.cli imports bodyseg_model.commands.train",
    ]


def test_rooms_are_small_enough_to_look_over() -> None:
    """At most a dozen entries beside the registry, and files that fit a few screens."""
    folders = {path.parent for path in modules().values()}
    crowded = {
        str(folder.relative_to(ROOT)): count
        for folder in folders
        if (count := sum(1 for entry in folder.iterdir() if entry.name[0] not in "._" and entry.suffix != ".typed"))
        > 16
    }
    assert not crowded
    long = {name: lines for name, path in modules().items() if (lines := len(path.read_text().splitlines())) > 450}
    assert not long
    loose = {entry.name for package in ("bodyseg_data", "bodyseg_model") for entry in (ROOT / package).glob("*.*")}
    assert loose <= {"__init__.py", "__main__.py", "py.typed"}


CHECKOUT_ONLY = re.compile(
    r"\b(?:tools|docs|tests)/|\bmake (?!an? |the |another )[a-z-]+|pip install '?(?:-e|\.)|\.venv|Makefile"
)
"""What an installed wheel has not: its folders, its targets, its environment."""


def said(path: Path) -> Iterable[str]:
    """What a file of a package may say to users: the strings of a module but its docstrings, other text files whole."""
    if path.suffix != ".py":
        return path.read_text().splitlines()
    nodes = list(ast.walk(ast.parse(path.read_text())))
    docstrings = {node.value for node in nodes if isinstance(node, ast.Expr)}
    strings = [node for node in nodes if isinstance(node, ast.Constant) and node not in docstrings]
    return [node.value for node in strings if isinstance(node.value, str)]


def test_an_installed_package_names_nothing_that_only_a_checkout_has(tmp_path: Path) -> None:
    files = [
        path for package in PACKAGES[:2] for path in (ROOT / package).rglob("*") if path.suffix in (".py", ".toml")
    ]
    texts = {path: list(said(path)) for path in files}
    assert sum(map(len, texts.values())) > 5000
    wrong = {str(path): [text for text in said if CHECKOUT_ONLY.search(text)] for path, said in texts.items()}
    assert not {path: found for path, found in wrong.items() if found}
    (tmp_path / "said.py").write_text(
        '"""See docs/explanation/noise.md."""\nraise E(f"{x}: run make install, see docs/x.md")\n'
    )
    assert [text for text in said(tmp_path / "said.py") if CHECKOUT_ONLY.search(text)] == [
        ": run make install, see docs/x.md"
    ]


def loaded_by(*statements: str) -> list[set[str]]:
    """Top-level modules loaded after each statement, run one after the other in a fresh process."""
    script = "import sys\n" + "".join(
        f"{statement}\nprint('\\nloaded', *{{name.partition('.')[0] for name in sys.modules}})\n"
        for statement in statements
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60)
    loaded = [set(line.split()[1:]) for line in done.stdout.splitlines() if line.startswith("loaded ")]
    assert len(loaded) == len(statements)
    return loaded


def loaded_too_much(statements: Mapping[str, Iterable[str]]) -> dict[str, set[str]]:
    """Statement -> what is loaded once it has run, of what is given with it."""
    return {
        statement: found
        for (statement, unwanted), loaded in zip(statements.items(), loaded_by(*statements), strict=True)
        if (found := loaded.intersection(unwanted))
    }


def test_imports_and_commands_load_no_more_than_they_need() -> None:
    """In one process, the statements that need least first: PyTorch alone takes two seconds to load."""
    light = {"torch", "numpy", *HEAVY}
    parser = {"cyclopts", "rich"}
    statements = {
        "import bodyseg_data": light | parser,
        "from bodyseg_data.commands.cli import main; main(['--version'])": light | parser,
        "from bodyseg_data.commands.cli import main; main(['--help'])": light | parser,
        "from bodyseg_data import RangeImages, loader, load_rig, Augmentation": {*HEAVY} | parser,
        "import bodyseg_data.commands.inspect, bodyseg_data.commands.verify": {*HEAVY} | parser,
        "import bodyseg_model.commands.train": {*HEAVY} | parser,
        "import bodyseg_data.bodies.sources; bodyseg_data.bodies.sources.open_source('open').bodies()": HEAVY,
        "import bodyseg_data.packing.pack": HEAVY,
        "import bodyseg_model.commands.segment, bodyseg_model.commands.evaluate": HEAVY,
        "import bodyseg_data.packing.engines.cluster, bodyseg_data.packing.engines.processes": HEAVY,
        "import bodyseg_data.commands.shard": HEAVY,
        "import scipy": {"scipy"},
    }
    assert loaded_too_much(statements) == {"import scipy": {"scipy"}}


def test_a_command_imports_no_other() -> None:
    script = "import sys; from bodyseg_data.commands.cli import main; main(['verify', '--help']); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60)
    loaded = set(done.stdout.splitlines()[-1].split())
    commands = {name for name in loaded if name.startswith(("bodyseg_data.commands.", "bodyseg_model."))}
    own = {f"bodyseg_data.commands.{name}" for name in ("cli", "options", "progress", "verify")}
    assert commands == own
    assert not {"torch", *HEAVY} & loaded


def test_streaming_installs_no_renderer() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    core = {name.partition(">")[0].partition("=")[0] for name in project["dependencies"]}
    assert core == {"numpy", "torch", "webdataset", "zstandard", "pillow", "safetensors", "tqdm", "cyclopts", "rich"}


def test_pymeshlab_is_installed_and_imported_by_choice_alone() -> None:
    """Its licence is GPL-3.0. tests/conftest.py keeps it from all tests but those that choose it."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    brings = re.compile(r"pymeshlab\b|bodyseg\[.*\bpymeshlab\b")
    assert {name for name, needs in extras.items() if any(map(brings.match, needs))} == {"pymeshlab", "dev"}
    naming = re.compile(r"^ *(import|from) pymeshlab\b|import_module\(.pymeshlab", re.MULTILINE)
    assert {name for name, path in modules().items() if naming.search(path.read_text())} == {
        "bodyseg_data.meshes.pymeshlab_thread"
    }
    calls = {name: path.read_text().count("with_pymeshlab(") for name, path in modules().items()}
    assert {name for name, count in calls.items() if count and name.startswith("bodyseg_")} == {
        "bodyseg_data.meshes.pymeshlab_thread",
        "bodyseg_data.meshes.repair",  # repair of scans, with --pymeshlab
        "bodyseg_data.packing.mesh_reduction",  # of large meshes, with --pymeshlab, or of all, with --tolerance-mm
    }


def test_every_dependency_is_pinned_and_explained() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pinned = {line.partition("==")[0].lower() for line in (ROOT / "tools/requirements.lock").read_text().splitlines()}
    explained = (ROOT / "docs" / "reference" / "dependencies.md").read_text()
    extras = [name for extra in project["optional-dependencies"].values() for name in extra if "bodyseg[" not in name]
    for needed in [*project["dependencies"], *extras]:
        name = needed.partition(">")[0].partition("=")[0].partition("[")[0]
        assert name.lower() in pinned
        assert f"`{name}`" in explained
