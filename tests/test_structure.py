"""Rules about the code as a whole: which way imports point, what importing costs, what no file may say."""

from __future__ import annotations

import ast
import functools
import graphlib
import importlib
import inspect
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path

from bodyseg_model.commands.cli import COMMANDS

ROOT = Path(__file__).parents[1]

PACKAGES = ("bodyseg_data", "bodyseg_model", "benches")
"""In the order in which they may import: each from those before it and from itself."""

HEAVY = [
    "OpenEXR",
    "OpenGL",
    "anny",
    "av",
    "distributed",
    "embreex",
    "h5py",
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


@functools.cache
def nodes_of(text: str) -> tuple[ast.AST, ...]:
    """All nodes of a module's syntax tree: many rules read the same hundreds of modules."""
    return tuple(ast.walk(ast.parse(text)))


def imports(text: str, known: set[str]) -> set[str]:
    """The project's modules that a module's text imports, or names in a string that is a module's dotted name."""
    found: set[str] = set()
    for node in nodes_of(text):
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
        "bodyseg_data.core.rig": "from bodyseg_data.loading import loaders",
        "bodyseg_data.loading.loaders": "import bodyseg_data.core.rig",
        "bodyseg_data.loose": "",
        "bodyseg_data.commands.cli": "TABLE = {'train': 'bodyseg_model.commands.train'}",
        "bodyseg_model.commands.train": "import bodyseg_data",
    }
    rooms = ["bodyseg_data.core", "bodyseg_data.loading", "bodyseg_data.commands", "bodyseg_model.commands"]
    assert faults(sources, rooms) == [
        "bodyseg_data.core.rig imports bodyseg_data.loading.loaders",
        "bodyseg_data.loose is in no room",
        "bodyseg_data.commands.cli imports bodyseg_model.commands.train",
    ]


THIRD_LEVEL = {
    "bodyseg_data.bodies.motions",  # motions
    "bodyseg_data.bodies.sources",  # sources of bodies
    "bodyseg_data.shards.codecs",  # codecs
    "bodyseg_model.recordings.formats",  # formats of recordings
}
"""Folders inside rooms: each holds kinds that share a protocol. Everything else is package, room, file."""


def room_of(module: str) -> str:
    """The room of a module, "bodyseg_data.core"; of a package's own files, the package; of benches, "benches"."""
    parts = module.split(".")
    return ".".join(parts[:2]) if parts[0] in PACKAGES[:2] and len(parts) > 1 and parts[1] != "__main__" else parts[0]


def from_imports(text: str, known: set[str]) -> Iterable[tuple[str, str | None]]:
    """(module, name) of every name that a text imports from the project; the name is None for a module as a whole.

    Of a room that is imported, as by commands, names are those that are looked up in it: `networks.load_network`.
    """
    rooms: dict[str, str] = {}
    for node in nodes_of(text):
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                if node.module in PACKAGES[:2] and whole in known:
                    rooms[alias.name] = whole
                else:
                    yield (whole, None) if whole in known else (str(node.module), alias.name)
        elif isinstance(node, ast.Import):
            yield from ((alias.name, None) for alias in node.names if alias.name in known)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value in known:
            yield node.value, None
    for node in nodes_of(text):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in rooms:
            yield rooms[node.value.id], node.attr


def past_doors(sources: dict[str, str], doors: Mapping[str, Iterable[str]]) -> list[str]:
    """Lines of modules that enter another room by one of its files, or take a name that no door has.

    doors: room -> the names of its door. A module of the benches may open a file of a room for what no door names, as
    it measures what users never see.
    """
    known = set(sources)
    lines = []
    for user, text in sources.items():
        for module, name in from_imports(text, known):
            room = room_of(module)
            if room == room_of(user) or room not in doors:
                continue
            named = name in doors[room]
            wrong = module != room and named if user.startswith("benches") else module != room or not named
            if wrong:
                lines.append(f"{user} imports {module}{'' if name is None else f': {name}'}")
    return lines


def doors() -> dict[str, list[str]]:
    """Room -> names of its door, for every room that has one."""
    rooms = [room for room in listed_rooms() if room.startswith(PACKAGES[:2])]
    names = {room: front(room) for room in rooms if room.split(".")[1] != "weights"}
    names["bodyseg_data.core"].append("lazy_door")  # imported at once, by all of them
    return names


def front(package: str) -> list[str]:
    """The names that a package offers."""
    return list(importlib.import_module(package).__all__)


def test_rooms_are_entered_by_their_doors() -> None:
    assert not past_doors({name: path.read_text() for name, path in modules().items()}, doors())


def test_a_way_past_a_door_is_seen() -> None:
    sources = {
        "bodyseg_data.core": "from bodyseg_data.core.files import write",
        "bodyseg_data.core.files": "",
        "bodyseg_data.shards.tar": "from bodyseg_data.core import write\nfrom bodyseg_data.core.files import write",
        "bodyseg_model.training.loop": "from bodyseg_data.core import hidden\nhome = 'bodyseg_data.core.files'",
        "bodyseg_model.commands.train": "from bodyseg_data import core\ncore.write(core.hidden)",
        "benches.loader": "from bodyseg_data.core.files import hidden\nfrom bodyseg_data.core.files import write",
    }
    assert past_doors(sources, {"bodyseg_data.core": ["write"]}) == [
        "bodyseg_data.shards.tar imports bodyseg_data.core.files: write",
        "bodyseg_model.training.loop imports bodyseg_data.core: hidden",
        "bodyseg_model.training.loop imports bodyseg_data.core.files",
        "bodyseg_model.commands.train imports bodyseg_data.core: hidden",
        "benches.loader imports bodyseg_data.core.files: write",
    ]


def test_no_file_hides_a_name_of_its_door() -> None:
    """Python puts a submodule, once imported, in the place of a name that is imported on first use."""
    for room, names in {**doors(), **{package: front(package) for package in PACKAGES[:2]}}.items():
        for name in names:
            assert not inspect.ismodule(getattr(importlib.import_module(room), name)), f"{room}.{name}"


LARGEST_DOORS = {
    "bodyseg_data.core": 26,
    "bodyseg_data.artifacts": 33,  # what a user's own artifact needs, and by what the fit of a sensor measures
    "bodyseg_data.files": 23,
    "bodyseg_data.shards": 59,  # a format, its columns and stores, which packing writes, loading reads, transfer copies
    "bodyseg_model.networks": 30,  # networks and their files, which training writes and everything else reads
    "bodyseg_data.meshes": 33,  # files, repair, checks, landmarks and parts of a mesh, whose one user is bodies
    "bodyseg_model.recordings": 22,
    "bodyseg_model.segmentation": 24,
    "bodyseg_data.samples": 33,
    "bodyseg_data.packing": 23,
}
"""Rooms that offer more names than 21: how many at most."""


def test_doors_are_small() -> None:
    sizes = {room: len(names) for room, names in doors().items()}
    assert not {room: size for room, size in sizes.items() if size > LARGEST_DOORS.get(room, 21)}


def test_every_name_of_a_door_is_used_outside_its_room() -> None:
    """By another room, by the package's own door, or by what documents teach."""
    sources = {name: path.read_text() for name, path in modules().items()}
    used: dict[str, set[str]] = {}
    for user, text in sources.items():
        for module, name in from_imports(text, set(sources)):
            if name is not None and room_of(user) != room_of(module):
                used.setdefault(module, set()).add(name)
    unused = {room: set(names) - used.get(room, set()) for room, names in doors().items()}
    assert not {room: names for room, names in unused.items() if names}


def circles(sources: dict[str, str]) -> list[list[str]]:
    """Circles of modules that import each other, by names in strings and for type checkers, too."""
    known = set(sources)
    imported = {module: {name for name, _ in from_imports(text, known)} - {module} for module, text in sources.items()}
    order = graphlib.TopologicalSorter(imported)
    found = []
    while True:
        try:
            order.prepare()
        except graphlib.CycleError as error:
            circle = error.args[1]
            found.append(circle)
            imported[circle[1]].discard(circle[0])
            order = graphlib.TopologicalSorter(imported)
        else:
            return found


def test_no_imports_run_in_a_circle() -> None:
    """Doors aside, which name all of their room."""
    shut = {*doors(), *PACKAGES}
    wheel = {name: path for name, path in modules().items() if name not in shut and not name.startswith("benches")}
    assert not circles({name: path.read_text() for name, path in wheel.items()})
    assert circles({"a": "import b", "b": "from c import d", "c": "home = 'a'"})


def test_rooms_have_no_cellars() -> None:
    """Package, room, file; files of one topic, read from top to bottom; and no more of them than a reader can know."""
    wheel = {name: path for name, path in modules().items() if not name.startswith("benches")}
    folders = {name.rpartition(".")[0] for name in wheel if name.count(".") > 2} - {""}
    assert folders == THIRD_LEVEL
    lines = {name: len(path.read_text().splitlines()) for name, path in wheel.items()}
    assert not {name: count for name, count in lines.items() if count > 520}
    assert len(wheel) <= 256
    assert sum(lines.values()) <= 48_000
    loose = {entry.name for package in PACKAGES[:2] for entry in (ROOT / package).glob("*.*")}
    assert loose <= {"__init__.py", "__main__.py", "py.typed"}


def test_no_two_public_classes_have_one_name() -> None:
    homes: dict[str, list[str]] = {}
    for module, path in modules().items():
        if not module.startswith("benches"):
            module_node, *_ = nodes_of(path.read_text())
            assert isinstance(module_node, ast.Module)
            for node in module_node.body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_") and node.name != "Options":
                    homes.setdefault(node.name, []).append(module)
    assert not {name: found for name, found in homes.items() if len(found) > 1}


CHECKOUT_ONLY = re.compile(
    r"\b(?:tools|docs|tests)/|\bmake (?!an? |the |another )[a-z-]+|pip install '?(?:-e|\.)|\.venv|Makefile"
)
"""What an installed wheel has not: its folders, its targets, its environment."""


def said(path: Path) -> Iterable[str]:
    """What a file of a package may say to users: the strings of a module but its docstrings, other text files whole."""
    if path.suffix != ".py":
        return path.read_text().splitlines()
    nodes = nodes_of(path.read_text())
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


def test_imports_load_no_more_than_they_need() -> None:
    """In one process, the statements that need least first: PyTorch alone takes two seconds to load."""
    light = {"torch", "numpy", *HEAVY}
    parser = {"cyclopts", "rich"}
    statements = {
        "import bodyseg_data": light | parser,
        "from bodyseg_model.commands.cli import main; main(['--version'])": light | parser,
        "main(['--help'])": light | parser,
        "from bodyseg_data import RangeImages, loader, load_rig, Augmentation": {*HEAVY} | parser,
        "from bodyseg_model import FrameLabeller, Segmenter, evaluate, load_network, train": {*HEAVY} | parser,
        "import bodyseg_data.bodies.sources; bodyseg_data.bodies.open_source('open').bodies()": HEAVY,
        "import bodyseg_data.packing.packer": HEAVY,
        "import bodyseg_data.packing.cluster, bodyseg_data.packing.jobs": HEAVY,
        "import scipy": {"scipy"},
    }
    assert loaded_too_much(statements) == {"import scipy": {"scipy"}}


def test_help_and_refused_options_come_without_pytorch() -> None:
    """Which is most of the time that a command takes to begin."""
    statements = {"from bodyseg_model.commands.cli import main; main(['train', '--lr', 'high'])": {"torch", *HEAVY}}
    statements |= {f"main({[*name.split(), '--help']})": {"torch", *HEAVY} for name in COMMANDS}
    missing = [
        "segment /none --out x",
        "sensor fit /none",
        "evaluate --data x --json /none/x.json",
        "view x --save /none",
    ]
    statements |= {f"main({words.split()})": {"torch", *HEAVY} for words in missing}
    assert not loaded_too_much(statements)


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
        "bodyseg_data.meshes.repairing"
    }
    calls = {name: path.read_text().count("with_pymeshlab(") for name, path in modules().items()}
    assert {name for name, count in calls.items() if count and name.startswith("bodyseg_")} == {
        "bodyseg_data.meshes.repairing",  # repair of scans, with --pymeshlab
        "bodyseg_data.packing.mesh_reduction",  # of large meshes, with --pymeshlab, or of all, with --tolerance-mm
    }


def test_every_dependency_is_pinned_and_explained() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pinned = {line.partition("==")[0].lower() for line in (ROOT / "tools/requirements.lock").read_text().splitlines()}
    explained = (ROOT / "docs" / "reference" / "dependencies.md").read_text()
    extras = [name for extra in project["optional-dependencies"].values() for name in extra if "bodyseg[" not in name]
    allowed: dict[str, str] = {}
    for needed in [*project["dependencies"], *extras]:
        name = needed.partition(">")[0].partition("=")[0].partition("[")[0]
        assert name.lower() in pinned
        assert f"`{name}`" in explained
        # An extra that allowed older versions than another was tried with none of them.
        assert allowed.setdefault(name, needed) == needed
