"""Code in the documents runs as it is written, beside a small set; what does not says why not."""

from __future__ import annotations

import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import pytest
from benches.__main__ import ALL
from benches.__main__ import COMMANDS as BENCH_COMMANDS
from folders import DOCS, PAGES, ROOT
from people_on_disk import write_by_vertex, write_mesh
from tutorials import read_tutorial, smaller

from bodyseg_data.artifacts import load_sensor_model
from bodyseg_data.commands.cli import load_command
from bodyseg_data.commands.options import parse
from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import Rig
from bodyseg_model.commands import main as bodyseg_main
from bodyseg_model.commands.cli import COMMANDS

DOCUMENTS: Final = sorted([ROOT / "README.md", *PAGES])

ELSEWHERE: Final = {
    "add_your_own.md": "each example runs by itself in test_how_to.py",
    "your_renders.md": "needs the set of its commands; test_your_renders.py runs both",
    "publish.md": "a set of nobody; tests/transfer/test_publish.py runs its commands",
    "remote.md": "the addresses are of nobody; tests/shards/test_stores.py reads from servers on loopback",
}
"""Documents whose Python is not run here, and why."""

NOT_RUN: Final = {
    'init_process_group("nccl")': "needs a GPU and torchrun; tests/training/test_torchrun.py has ranks",
    "from webdataset import": "tests/loading/test_pipelines.py has these steps; readers of streams leave files open",
    'planes=("instances",)': "needs a set with planes; tests/loading/test_open_sets.py has one",
    "from datasets import": "writes into its own cache; tests/benches/cards reads a set by it",
    "import mlcroissant": "needs the cards of a set; tests/benches/cards reads them by it",
    "import ray": "needs Ray; the function that it calls runs in the block before",
    "from pyspark": "needs Spark; the function that it calls runs in the block before",
    "from live_cameras import realsense": "needs a camera; tests/recordings has stand-ins for two",
}
"""Text of a block that is not run -> why."""

SMALLER: Final = {
    "range(90)": "range(2)",
    "batches.epoch, 90": "batches.epoch, 2",
    '"shards", "all"), 500': '"shards", "all"), 2',
    "steps=2000": "steps=1, batch_size=1, bf16=False",
    "noise_mm=40), 500": "noise_mm=40), 2",
    'total(["A", "B"])': 'total(["A"])',
    "iter(images)\n": "iter([images[0]])\n",
    '"subject=B,C", "motion=cra*", ': "",
}
"""Numbers and names -> others for a small set, of few people."""

BEFORE: Final = {
    "recordings.md": (
        "import numpy as np\narrays = [np.full((4, 6), 1500, np.uint16)]\nnp.save('frames.npy', np.stack(arrays))\n"
    ),
    "robot.md": (
        "import pathlib, PIL.Image\nfrom bodyseg_data import RangeImages, example_set\n"
        "pathlib.Path('recording').mkdir()\n"
        "for i in range(2):\n"
        "    millimetres = 1000 * RangeImages(example_set(), 'occ', 'test')[i]['range'][0].numpy()\n"
        "    PIL.Image.fromarray(millimetres.astype('uint16')).save(f'recording/{i}.png')\n"
    ),
    "columns.md": (
        "import pathlib, shutil\nlink = pathlib.Path('my-shards')\nwhole = link.resolve()\nlink.unlink()\n"
        "shutil.copytree(whole, link)\n"
    ),
    "streaming.md": (
        "import torch\nfrom torch.utils.data import DataLoader\n"
        "from torchdata.stateful_dataloader import StatefulDataLoader\n"
        "network, path = torch.nn.Linear(1, 1), 'state.pt'\n"
    ),
}
"""Names that a document's text introduces, or that its reader has at hand."""

AFTER: Final = {
    "engines.md": "one = RangeImages(urls[0], 'all', seed=0)[0]\n"
    "assert rows[0]['range'].dtype == 'float32' and (rows[0]['range'] == one['range'].numpy()).all()",
    "robot.md": "found = pathlib.Path('parts.csv').read_text().splitlines()\n"
    "assert len(found) > 30 and found[1].startswith('0,,1,Sellion,') and found[-1].startswith('1,,')",
}
"""Document -> code that is run after its blocks: what they say of their results."""

PYTHON: Final = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
SHELL: Final = re.compile(r"^(?: {4})?((?:tools/|bodyseg )[a-z]+(?:-[a-z]+)* .*)$", re.MULTILINE)


def examples(document: Path) -> list[str]:
    """The Python blocks of a document that run here."""
    blocks = [] if document.name in ELSEWHERE else PYTHON.findall(document.read_text())
    return [block for block in blocks if not any(text in block for text in NOT_RUN)]


@pytest.fixture
def workplace(paper_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, prepared: list[Rig]) -> Path:
    """A folder with all that the documents' code reads, as the current one."""
    for name in ("shards", "my-camera", "my-shards"):
        (tmp_path / name).symlink_to(paper_set)
    (tmp_path / "my_sensor.toml").write_text(load_sensor_model("kinect_v1").to_toml())
    shutil.copy(ROOT / "bodyseg_data" / "labels" / "limbs14.toml", tmp_path / "my_classes.toml")
    run = tmp_path / "runs" / "all-0"
    run.mkdir(parents=True)
    for suffix in ("json", "safetensors"):
        (run / f"network.{suffix}").symlink_to(ROOT / "bodyseg_model" / "weights" / f"compact.{suffix}")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.filterwarnings("ignore:'set_vital' is deprecated")  # torchdata calls it
@pytest.mark.parametrize("document", [each for each in DOCUMENTS if examples(each)], ids=lambda each: each.name)
def test_the_python_of_a_document_runs(document: Path, workplace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("example")
    monkeypatch.setitem(sys.modules, module.__name__, module)  # where dataclasses look for their module
    exec(BEFORE.get(document.name, ""), module.__dict__)
    for block in examples(document):
        for long, short in SMALLER.items():
            block = block.replace(long, short)
        exec(compile(block, str(document), "exec"), module.__dict__)
    exec(AFTER.get(document.name, ""), module.__dict__)


def test_reasons_are_of_blocks_that_are_there() -> None:
    texts: dict[str, str] = {}
    for document in DOCUMENTS:  # a how-to and its page of results may have one name
        texts[document.name] = "\n".join([texts.get(document.name, ""), *PYTHON.findall(document.read_text())])
    assert all(texts[name].strip() for name in ELSEWHERE)
    assert set(BEFORE) <= {name for name, text in texts.items() if text.strip()}
    assert all(any(part in text for text in texts.values()) for part in (*NOT_RUN, *SMALLER))


def command_lines(document: Path) -> Iterator[list[str]]:
    """The words of every command line of a document's code, comments left out."""
    for line in SHELL.findall(document.read_text().replace("\\\n", " ")):
        yield shlex.split(line.removeprefix("tools/").removeprefix("bodyseg "), comments=True)


TABLE: Final = {**COMMANDS, **BENCH_COMMANDS, **ALL}

WALKED: Final = {
    "start.md": [],
    "your_meshes.md": [],
}
"""Documents whose command lines run here, and commands among them that take longer and have tests of their own.

test_tutorial.py runs those of your_camera.md, test_your_renders.py those of your_renders.md. Those of all others
take minutes to days and are only read, with every option and value, as the command itself reads them.
"""

SIZES: Final = {
    "shard --views": "1",
    "shard --distances": "255",
    "shard --workers": "1",
    "shard --geodesics": "edges",
}
"""Options that make the commands short."""


def read(words: list[str]) -> Any:
    """The options that a command reads from its words. Raises BadConfig."""
    name = " ".join(words[:2]) if " ".join(words[:2]) in TABLE else words[0]
    place, summary = TABLE[name]
    command = load_command(place)
    return parse(command.Options, words[len(name.split()) :], name, summary, command.EXAMPLE)


def test_commands_read_every_command_line() -> None:
    lines = [words for document in DOCUMENTS for words in command_lines(document)]
    assert len(lines) > 60
    assert all(read(words) is not None for words in lines)
    with pytest.raises(BadConfig, match="--views"):
        read(["shard", "--source", "open", "--views", "many"])


def write_two_people(folder: Path) -> None:
    for place in ("train/anna", "test/ben"):
        write_mesh(folder / place / "standing.ply")
        write_by_vertex(folder / place / "landmarks.json")


@pytest.mark.usefixtures("packing_here")
@pytest.mark.parametrize("name", WALKED)
def test_the_commands_of_a_tutorial_run(name: str, workplace: Path, capfd: pytest.CaptureFixture[str]) -> None:
    document = DOCS / "tutorials" / name
    (workplace / "my-shards").unlink()
    write_two_people(workplace / "meshes")
    if name == "start.md":
        exec(compile(PYTHON.findall(document.read_text())[-1], name, "exec"), {})  # writes the frames
    commands = [command for command in read_tutorial(document).commands if command[0] not in WALKED[name]]
    assert commands
    for command in commands:
        assert bodyseg_main(smaller(command, SIZES)) == 0, (command, capfd.readouterr().err)
