from __future__ import annotations

import contextlib
import importlib
import inspect
import io
import json
import os
import resource
import signal
import subprocess
import sys
import typing
import warnings
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from benches import __main__ as tools
from benches import bench
from folders import ROOT
from PIL import Image

import bodyseg_data
import bodyseg_model
from bodyseg_data.commands import check_target, cli, option, verify
from bodyseg_data.commands.options import parse
from bodyseg_data.core import BadConfig
from bodyseg_data.labels import load_label_map
from bodyseg_model.commands import main
from bodyseg_model.commands.cli import COMMANDS


@dataclass(frozen=True)
class Everything:
    name: str = option("a name", positional=True)
    count: int = option("how many", 3)
    share: float | None = option("a share", None)
    kind: Literal["a", "b"] = option("which", "a")
    sizes: tuple[int, ...] = option("sizes", (1, 2))
    out: Path | None = option("a file", None)
    loud: bool = option("say it loud", False)


def parsed(*words: str) -> Everything | None:
    return parse(Everything, words, "bodyseg test", "A test.", "bodyseg test x")


def test_a_dataclass_is_the_command_line() -> None:
    assert parsed("x") == Everything("x")
    words = [
        "x",
        "--count",
        "5",
        "--share",
        "0.5",
        "--kind",
        "b",
        "--sizes",
        "7",
        "8",
        "9",
        "--out",
        "here.png",
        "--loud",
    ]
    assert parsed(*words) == Everything("x", 5, 0.5, "b", (7, 8, 9), Path("here.png"), True)


def test_a_later_option_counts_and_a_value_may_follow_an_equals_sign() -> None:
    assert parsed("x", "--count=5", "--count", "-7", "--sizes", "1", "--sizes", "-2", "3").count == -7
    assert parsed("--sizes", "1", "--kind=b", "x") == Everything("x", 3, None, "b", (1,))
    assert parsed("--sizes", "1", "2", "--", "x").sizes == (1, 2)
    assert parsed("x", "--out=-y").out == Path("-y")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "Parameter NAME is missing (see bodyseg test --help)"),
        (["--out", "x", "--loud"], "NAME is missing, or taken by an option before it: give it first (see"),
        (["x", "y"], "no option takes ['y'] (see bodyseg test --help)"),
        (["x", "--count"], "--count requires an argument"),
        (["x", "--sizes"], "--sizes requires at least 1"),
        (["x", "--count", "many"], 'for --count: unable to convert "many" into int'),
        (["x", "--count", "2.7"], 'for --count: unable to convert "2.7" into int'),
        (["x", "--sizes", "1", "1e3"], 'for --sizes: unable to convert "1e3" into int'),
        (["x", "--share", "none"], 'for --share: unable to convert "none" into float'),
        (["x", "--kind", "c"], 'Invalid value "c" for --kind. Choose from: "a", "b"'),
        (["x", "--kind", "A"], 'Invalid value "A" for --kind. Choose from: "a", "b"'),
        (["x", "--colour", "red"], "Unknown option: --colour."),
        (["x", "--lou"], "Unknown option: --lou. Did you mean --loud?"),
        (["x", "--no-loud"], "Unknown option: --no-loud."),
        (["x", "--name", "x"], "Unknown option: --name."),
        (["x", "--out", ""], 'for --out: unable to convert "" into Path'),
        (["x", "--out="], 'for --out: unable to convert "" into Path'),
        (["x", "--out", "s3://me:secret@bucket/x"], "of this machine is needed, found the address s3://bucket/x"),
    ],
)
def test_a_bad_argument_is_one_line(words: list[str], message: str) -> None:
    with pytest.raises(BadConfig) as caught:
        parsed(*words)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_help_shows_defaults_choices_and_an_example(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    assert parsed("x", "--help") is None
    text = capsys.readouterr().out
    assert text.isascii()
    assert "\x1b" not in text
    assert max(map(len, text.splitlines())) <= 60
    for line in (
        "Usage: bodyseg test [OPTIONS] NAME",
        " *  NAME  a name [required]",
        " --count INT     how many [default: 3]",
        " --share FLOAT   a share",
        " --kind CHOICE   which [choices: a, b] [default: a]",
        " --sizes INT...  sizes [default: 1 2]",
        " --out PATH      a file",
        " --loud          say it loud",
        "example:",
        "  bodyseg test x",
    ):
        assert line in text.splitlines()


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_with_an_example(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert main([*name.split(), "--help"]) == 0
    # One line, also in a terminal of usual width: what is broken into two cannot be copied.
    head, example = capsys.readouterr().out.rstrip().splitlines()[-2:]
    assert head == "example:"
    assert example.startswith(f"  bodyseg {name}")


@pytest.mark.parametrize("name", tools.COMMANDS)
def test_every_tool_of_a_checkout_has_help_with_an_example(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert tools.main([name, "--help"]) == 0
    head, example = capsys.readouterr().out.rstrip().splitlines()[-2:]
    assert head == "example:"
    assert example.startswith(f"  tools/{name} ")


@pytest.mark.parametrize("name", [*COMMANDS, *tools.COMMANDS])
def test_every_command_is_a_tool_in_a_checkout(name: str) -> None:
    tool = ROOT / "tools" / name.split()[0]
    assert tool.is_file()
    assert os.access(tool, os.X_OK)
    assert tool.resolve().name == "bodyseg_command"


def test_the_overview_lists_all_commands(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(f"  {name}" in text for name in COMMANDS)


@pytest.mark.parametrize("words", [["--version"], ["verify", "--version"]])
def test_the_version_is_that_of_what_is_installed(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 0
    version = metadata.version("bodyseg")
    assert capsys.readouterr().out == f"bodyseg {version}\n"
    assert bodyseg_data.__version__ == bodyseg_model.__version__ == version


def test_a_checkout_that_was_never_installed_has_a_version(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(name: str) -> str:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", none)
    assert bodyseg_data.__version__ == bodyseg_model.__version__ == "0+unknown"
    for package in (bodyseg_data, bodyseg_model):
        with pytest.raises(AttributeError, match=f"module '{package.__name__}' has no attribute 'versions'"):
            package.versions  # noqa: B018


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["pack"], "bodyseg pack: no such command; there are shard, join, verify, inspect"),
        (["shard"], "bodyseg shard: Parameter --source is missing (see bodyseg shard --help)"),
        (["shard", "--source", "open"], "bodyseg shard: --out is missing"),
        (
            ["shard", "--source", "open", "--out", "x", "--views", "55"],
            "views a mesh must be between 1 and 54, found 55",
        ),
        (
            ["shard", "--source", "open", "--out", "x", "--workers", "0"],
            "workers must be a whole number from 1 to 1024, found 0",
        ),
        (
            ["shard", "--source", "open", "--plan", "--engine", "dask"],
            "the engine must be processes or dask://HOST:PORT",
        ),
        (
            ["shard", "--source", "open", "--out", "x", "--engine", "dask://127.0.0.1:1"],
            "no Dask scheduler at 127.0.0.1:1",
        ),
        (["bench", "scaling", "--figure", "x.png"], "tools/bench: bench scaling draws no figure: leave --figure out"),
        (["bench", "render", "--figure", "x.jpg"], "tools/bench: --figure must be a .png file, found x.jpg"),
        (
            ["bench", "occlusion", "--json", "none/x.json"],
            "--json needs a file in a folder that is there, found none/x",
        ),
        (["landmarks", "--source", "open", "--out", "x.png", "--height", "0"], "100 to 4000 pixels, found 0"),
        (["bench", "partition", "--views", "3"], "tools/bench: bench partition measures whole bodies"),
        (
            ["bench", "render", "--mit", "x"],
            "--mit is for bench partition, reduction, clothes, proposal, found it with",
        ),
        (["shard", "--source", "mit", "--path", "nowhere", "--plan"], "bodyseg shard: "),
        (["shard", "--source", "open", "--plan", "--rig", "no.toml"], "cannot read the rig file no.toml"),
        (["inspect", "nowhere", "--json"], "bodyseg inspect: no such folder: nowhere"),
        (["bench", "codec", "--figure", "none/x.png"], "--figure needs a file in a folder that is there, found none/x"),
        (["inspect", "nowhere"], "bodyseg inspect: nothing to do: give --out FILE.png, --json, or both"),
        (["inspect", "nowhere", "--out", "x.jpg"], "bodyseg inspect: --out must be a .png file, found x.jpg"),
        (["landmarks", "--source", "open", "--out", "x.png", "--pymeshlab"], "reads no files: leave --pymeshlab out"),
        (["landmarks", "--source", "open", "--out", "x.xyz"], "--out must be a .png file, found x.xyz"),
        (["inspect", "nowhere", "--json", "--rows", "0"], "bodyseg inspect: --rows must be 1 to 500, found 0"),
        (["inspect", "nowhere", "--json", "--rows", "501"], "bodyseg inspect: --rows must be 1 to 500, found 501"),
        (
            ["inspect", "nowhere", "--out", "no/folder/x.png"],
            "bodyseg inspect: --out needs a file in a folder that is there, found no/folder/x.png",
        ),
    ],
)
def test_bad_input_is_one_line_and_exit_status_2(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (tools.main if words[0] in tools.COMMANDS else main)(words) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    lines = [
        line for line in printed.err.splitlines() if not line.startswith("packing: starting, ")
    ]  # every five seconds
    assert len(lines) == 1
    assert printed.out == ""


def test_a_plan_is_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["shard", "--source", "open", "--meshes", "10", "--views", "2", "--plan"]) == 0
    plan = json.loads(capsys.readouterr().out)
    assert (plan["meshes"], plan["views"]) == (10, 20)


def test_a_surprise_is_one_line_unless_the_trace_is_asked_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(options: object) -> int:
        raise ZeroDivisionError("by zero\nindeed")

    monkeypatch.setattr(verify, "run", fail)
    monkeypatch.delenv("BODYSEG_TRACEBACK", raising=False)
    assert main(["verify", "x"]) == cli.INTERNAL_ERROR
    line = "bodyseg verify: internal error: ZeroDivisionError: by zero indeed (BODYSEG_TRACEBACK=1 shows where)\n"
    assert capsys.readouterr().err == line

    class Wordless(Exception):
        def __str__(self) -> str:
            raise ValueError

    def fail_without_words(options: object) -> int:
        raise Wordless

    with monkeypatch.context() as patched:
        patched.setattr(verify, "run", fail_without_words)
        assert main(["verify", "x"]) == cli.INTERNAL_ERROR
    assert ": internal error: Wordless (BODYSEG_TRACEBACK=1" in capsys.readouterr().err

    monkeypatch.setenv("BODYSEG_TRACEBACK", "1")
    with pytest.raises(ZeroDivisionError):
        main(["verify", "x"])

    def fail_in_code_of_a_user(options: object) -> int:
        with BadConfig.named("artifact 'mine'"):
            return int(1 / 0)

    monkeypatch.setattr(verify, "run", fail_in_code_of_a_user)
    with pytest.raises(BadConfig, match="artifact 'mine': ZeroDivisionError: division by zero"):
        main(["verify", "x"])
    monkeypatch.delenv("BODYSEG_TRACEBACK")
    assert main(["verify", "x"]) == 2


def test_a_warning_is_one_line_without_a_place_in_the_code(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def warn(options: object) -> int:
        sys.stderr.write(warnings.formatwarning("the disk\nis full", RuntimeWarning, "cache.py", 7))
        return 0

    monkeypatch.setattr(verify, "run", warn)
    monkeypatch.delenv("BODYSEG_TRACEBACK", raising=False)
    plain = warnings.formatwarning
    assert main(["verify", "x"]) == 0
    assert capsys.readouterr().err == "bodyseg verify: warning: the disk is full\n"
    assert warnings.formatwarning is plain
    monkeypatch.setenv("BODYSEG_TRACEBACK", "1")
    assert main(["verify", "x"]) == 0
    assert capsys.readouterr().err == "cache.py:7: RuntimeWarning: the disk\nis full\n"


def test_a_limit_of_threads_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def start(options: object) -> int:
        raise RuntimeError("can't start new thread")  # as Python says

    monkeypatch.setattr(verify, "run", start)
    assert main(["verify", "x"]) == 2
    line = "bodyseg verify: no thread can be started: ulimit -u or the container allows no more\n"
    assert capsys.readouterr().err == line


@pytest.mark.parametrize(("allowed", "noted"), [(-1, False), (1_500_000_000, True), (2**63 - 1, False)])
def test_a_limit_of_memory_is_said_beforehand(
    allowed: int, noted: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (allowed, allowed))
    monkeypatch.setattr(verify, "run", lambda _: 0)
    assert main(["verify", "x"]) == 0
    assert ("bodyseg verify: note: ulimit -v allows 1.5 GB" in capsys.readouterr().err) == noted


def test_texts_are_printed_where_the_locale_has_ascii_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def measured(options: object) -> int:
        sys.stdout.write("12 ± 1 mm")
        return 0

    monkeypatch.setattr(verify, "run", measured)
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), "ascii", "surrogateescape"))  # as in POSIX's
    assert main(["verify", "x"]) == 0
    sys.stdout.seek(0)
    assert sys.stdout.read() == r"12 \xb1 1 mm"


@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_paths_are_printed_whatever_their_letters(
    encoding: str, figures_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "people é \udcff"
    folder.symlink_to(figures_set)
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding))
    assert main(["verify", str(folder)]) == 0
    sys.stdout.seek(0)
    assert sys.stdout.read().endswith("no fault\n")


def test_a_path_that_a_library_cannot_open_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def opens(options: object) -> int:
        "/runs/\udcff".encode()  # as TensorBoard and pyarrow do
        return 0

    monkeypatch.setattr(verify, "run", opens)
    assert main(["verify", "x"]) == 2
    assert capsys.readouterr().err == "bodyseg verify: a path must be UTF-8 here, found '/runs/\\udcff'\n"


def test_an_interrupt_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupt(options: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(verify, "run", interrupt)
    assert main(["verify", "x"]) == 130
    assert capsys.readouterr().err == "bodyseg verify: interrupted\n"


@pytest.mark.parametrize("error", [SystemError, BadConfig])  # the second where it is about an artifact
@pytest.mark.parametrize(("number", "said"), [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "terminated")])
def test_an_interrupt_that_c_has_made_another_error_of_is_one(
    number: signal.Signals,
    said: str,
    error: type[Exception],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """As by a second Ctrl-C while LLVM, which calls Python, compiles a loop."""

    def compiling(options: object) -> int:
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(number)
        raise error("a callback has raised")

    monkeypatch.setattr(verify, "run", compiling)
    # Ignored where tests run in the background; and a command that one ends leaves both ignored.
    before = {each: signal.signal(each, signal.default_int_handler) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        assert main(["verify", "x"]) == 128 + number
        assert capsys.readouterr().err == f"bodyseg verify: {said}\n"
        monkeypatch.setattr(verify, "run", lambda options: 1 // 0)
        assert main(["verify", "x"]) == 70
    finally:
        for each, action in before.items():
            signal.signal(each, action)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_is_ignored_stays_ignored(number: signal.Signals, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a background job of a script, which Ctrl-C is not meant for."""

    def interrupted(options: Any) -> int:
        signal.raise_signal(number)
        return 0

    monkeypatch.setattr(verify, "run", interrupted)
    before = signal.signal(number, signal.SIG_IGN)
    actions = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    try:
        assert cli.main(["verify", "shards"]) == 0
        assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == actions
    finally:
        signal.signal(number, before)


@pytest.mark.parametrize("words", ["verify {set}", "--help"])
def test_a_reader_that_goes_away_is_said_by_the_status_alone(words: str, small_set: Path) -> None:
    command = f"{sys.executable} -m bodyseg_model {words.format(set=small_set)}"
    script = f"{command} 2> >(grep -v verifying >&2) | true; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 141
    assert done.stderr == ""


def test_output_that_cannot_be_written_is_one_line(small_set: Path) -> None:
    script = f"{sys.executable} -m bodyseg_model verify {small_set} >/dev/full"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == "bodyseg verify: No space left on device"


def test_a_current_folder_that_was_deleted_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert main(["verify", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith("bodyseg verify: the current folder was deleted")


def test_closed_streams_change_no_status(small_set: Path) -> None:
    script = f"{sys.executable} -m bodyseg_model verify {small_set} >&- 2>&-"
    assert subprocess.run(["bash", "-c", script], capture_output=True, timeout=60, check=False).returncode == 0


def test_inspect_counts_and_draws_classes(
    figures_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["inspect", str(figures_set), "--variant", "none", "--json"]
    assert main(words) == 0
    parts = json.loads(capsys.readouterr().out)["class_shares"]
    assert main([*words, "--labels", "limbs14", "--rows", "1", "--out", str(tmp_path / "sheet.png")]) == 0
    shares = json.loads(capsys.readouterr().out)["class_shares"]
    limbs = load_label_map("limbs14")
    assert list(shares) == list(limbs.names)
    for name, landmarks in limbs.classes:
        assert shares[name] == pytest.approx(sum(parts[each] for each in landmarks), abs=2e-3)
    with Image.open(tmp_path / "sheet.png") as sheet:
        shown = {tuple(colour) for colour in np.asarray(sheet.convert("RGB")).reshape(-1, 3).tolist()}
    assert {tuple(colour) for colour in limbs.colours.tolist()} <= shown
    assert main([*words, "--labels", "limbs"]) == 2
    assert "bodyseg inspect: no label map is called 'limbs'" in capsys.readouterr().err


@pytest.mark.parametrize("variant", ["none", "all"])
def test_inspect_counts_what_a_set_holds(figures_set: Path, variant: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(figures_set), "--variant", variant, "--json"]) == 0
    counts = json.loads(capsys.readouterr().out)
    assert counts["samples"] == 24
    assert counts["splits"] == {"train": 16, "test": 8}
    assert counts["subsets"] == {"A": 12, "people": 12}
    total = sum(path.stat().st_size for path in figures_set.glob("*.tar"))
    assert total - 6 * 10240 - 6 * 1024 < counts["bytes"] < total, "all but the archives' ends"
    assert len(counts["class_shares"]) == 33
    assert sum(counts["class_shares"].values()) == pytest.approx(1, abs=0.01)
    if variant == "none":
        assert counts["kept"] == 1
        assert counts["mean_sigma_mm"] is None
    else:
        assert 0.5 < counts["kept"] < 0.95
        assert 30 < counts["mean_sigma_mm"] < 70


def test_inspect_draws_a_contact_sheet(small_set: Path, tmp_path: Path) -> None:
    out = tmp_path / "sheet.png"
    assert main(["inspect", str(small_set), "--variant", "occ", "--rows", "2", "--out", str(out)]) == 0
    with Image.open(out) as sheet:
        assert sheet.width > 1400
        assert sheet.height > 2 * 320
        assert len(sheet.convert("RGB").getcolors(1 << 24) or []) > 500
    assert [path.name for path in tmp_path.iterdir()] == ["sheet.png"]


def test_a_sheet_of_two_artifacts_has_their_panel_beside_the_five_variants(small_set: Path, tmp_path: Path) -> None:
    five, six = tmp_path / "five.png", tmp_path / "six.png"
    for variant, out in (("md", five), ("noise+md", six)):
        assert main(["inspect", str(small_set), "--variant", variant, "--rows", "1", "--out", str(out)]) == 0
    with Image.open(five) as plain, Image.open(six) as wider:
        assert wider.width > plain.width + 100


def test_a_picture_that_cannot_be_written_is_one_line(
    small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["inspect", str(small_set), "--out", str(tmp_path / "none" / "sheet.png")]) == 2
    assert "--out needs a file in a folder that is there" in capsys.readouterr().err


def test_every_bench_has_its_module_and_its_figure() -> None:
    assert typing.get_args(typing.get_type_hints(bench.Options)["what"]) == tuple(bench.BENCHES)
    for name, takes in bench.BENCHES.items():
        home = f"benches.{takes.module}"
        measure = getattr(importlib.import_module(home), f"bench_{name}")
        parameters = inspect.signature(measure).parameters
        assert {"progress", *takes.accepted} == set(parameters)
        assert {name for name, found in parameters.items() if found.default is found.empty} == set(takes.required)
        if takes.figure is not None:
            figure = importlib.import_module(f"{home.rpartition('.')[0]}.{takes.figure}")
            assert callable(getattr(figure, f"draw_{name}"))


@pytest.mark.parametrize("name", ["stdout", "null", "new"])
def test_results_are_no_devices(name: str) -> None:
    with pytest.raises(BadConfig, match=f"^--json needs a file in a folder that is there, found /dev/{name}$"):
        check_target(Path("/dev", name), "--json")
