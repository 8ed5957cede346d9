"""`tools/bench all` on steps of tiny commands: what is stale runs, in order, and nothing else does."""

from __future__ import annotations

import dataclasses
import fcntl
import json
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from made_steps import RESULT, TRAINING, Workshop, a_page, a_result, a_set, a_training, shell

from bodyseg_data.core import BadConfig

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def shop(tmp_path: Path) -> Workshop:
    return Workshop(tmp_path)


@pytest.fixture
def interruptible() -> Iterator[None]:
    """SIGINT raises KeyboardInterrupt and SIGTERM ends steps, also where the tests were started with them ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler), signal.signal(signal.SIGTERM, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGINT, before[0])
    signal.signal(signal.SIGTERM, before[1])


def ended(capture: Capture, word: str = "done") -> list[str]:
    """Names of the steps that ended with this word, in order."""
    return [line.split()[1].rstrip(":") for line in capture.readouterr().err.splitlines() if line.startswith(word)]


def test_all_steps_run_once(shop: Workshop, capsys: Capture) -> None:
    assert shop.run() == 0
    assert ended(capsys) == ["sets/a", "runs/x-0", "runs/y-0", "x", "y", "page"]
    assert shop.results() == {"x": {"of": "bodies"}, "y": {"of": "bodies"}}
    assert (shop.home / "results" / "index.md").read_text().count("bodies") == 2
    assert shop.run() == 0
    assert capsys.readouterr().err == "0 made, 6 fresh\n"


def test_a_record_says_what_was_read_and_made(shop: Workshop) -> None:
    shop.run()
    records = shop.records()
    assert [*records] == ["page", "runs/x-0", "runs/y-0", "sets/a", "x", "y"]
    assert records["x"]["command"] == shop.steps[3].command
    assert [*records["x"]["inputs"]] == ["runs/x-0"] and [*records["x"]["made"]] == ["x.json"]
    assert [*records["sets/a"]["inputs"]] == ["data/bodies"]
    assert records["x"]["seconds"] >= 0 and records["x"]["commit"] and records["x"]["hardware"]


def test_edited_code_makes_its_step_stale_and_those_behind_it_only_if_its_product_changes(
    shop: Workshop, capsys: Capture
) -> None:
    shop.run()
    shop.code["code.of.runs/x-0"] = "edited"
    assert shop.run(list=True) == 1
    listed = {line.split()[0]: line.split(None, 2)[1:] for line in capsys.readouterr().out.splitlines()}
    assert [name for name, (state, *_) in listed.items() if state == "stale"] == ["runs/x-0", "x"]
    assert listed["runs/x-0"][1].endswith("the code has changed") and listed["x"][1].endswith("after runs/x-0")
    assert shop.run() == 0
    assert ended(capsys) == ["runs/x-0"], "the same weights came out"


def test_other_data_makes_all_behind_it_anew(shop: Workshop, capsys: Capture) -> None:
    shop.run()
    (shop.home / "data" / "bodies").write_text("others")
    capsys.readouterr()
    assert shop.run() == 0
    assert ended(capsys) == ["sets/a", "runs/x-0", "runs/y-0", "x", "y", "page"]
    assert shop.results()["y"] == {"of": "others"}
    replaced = shop.home / "work" / "replaced"
    assert (replaced / "sets" / "a.1" / "manifest.json").read_text() == "bodies", "nothing is deleted"
    (shop.home / "data" / "bodies").write_text("third")
    shop.run()
    assert (replaced / "sets" / "a.2" / "manifest.json").read_text() == "others"


def test_another_command_is_stale(shop: Workshop, capsys: Capture) -> None:
    shop.run()
    shop.steps[3] = a_result("x", "runs/x-0", RESULT + "# measured otherwise")
    capsys.readouterr()
    assert shop.run(list=True) == 1
    assert "the command has changed" in capsys.readouterr().out
    shop.run()
    assert ended(capsys) == ["x"], "the page is of the same figures"


def test_a_result_that_was_altered_is_made_anew_and_the_page_with_it(shop: Workshop, capsys: Capture) -> None:
    shop.run()
    (shop.home / "results" / "x.json").write_text("{}")
    (shop.home / "results" / "y.json").unlink()
    capsys.readouterr()
    assert shop.run(list=True) == 1
    listed = capsys.readouterr().out
    assert "the product is not the one that was made" in listed and "the product is missing" in listed
    assert shop.run() == 0
    assert ended(capsys) == ["x", "y"]
    assert shop.results() == {"x": {"of": "bodies"}, "y": {"of": "bodies"}}


def test_in_a_fresh_checkout_trainings_are_made_only_for_stale_results(shop: Workshop, capsys: Capture) -> None:
    shop.run()
    (shop.home / "work").rename(shop.home / "elsewhere")
    capsys.readouterr()
    assert shop.run(list=True) == 0
    assert "6 steps: 3 absent, 3 fresh\n" in capsys.readouterr().out
    assert not (shop.home / "work").exists(), "--list writes nothing"
    shop.code["code.of.y"] = "edited"
    assert shop.run() == 0
    assert ended(capsys) == ["sets/a", "runs/y-0", "y"]


def test_results_from_before_records_were_kept_are_stale(shop: Workshop, capsys: Capture) -> None:
    shop.run()
    file = shop.home / "results" / "steps.json"
    tree = json.loads(file.read_text())
    tree["steps"]["x"]["code"] = None
    file.write_text(json.dumps(tree))
    assert shop.run("x", list=True) == 1
    assert "made before records were kept" in capsys.readouterr().out


def test_without_its_data_a_step_is_blocked_and_so_are_those_behind_it(shop: Workshop, capsys: Capture) -> None:
    shop.steps.insert(0, a_result("z", "data/z", 'cp "$0" "$1"'))
    (shop.home / "data" / "bodies").unlink()
    assert shop.run(list=True) == 1
    listed = capsys.readouterr().out
    assert f"{shop.home}/data/bodies is not there" in listed and "needs sets/a, which cannot be made" in listed
    (shop.home / "data" / "z").write_text("{}")
    assert shop.run() == 1
    assert ended(capsys) == ["z", "page"], "what needs nothing else is made"


def test_a_step_that_needs_a_gpu_is_blocked_without_one(shop: Workshop, capsys: Capture) -> None:
    torch = pytest.importorskip("torch")
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    shop.steps[1] = a_training("runs/x-0", gpu=True)
    assert shop.run("x", list=True) == 1
    assert shop.run("runs/x-0", list=True) == 1
    assert "needs a GPU" in capsys.readouterr().out


def test_an_absent_training_that_cannot_be_made_blocks_what_needs_it(shop: Workshop, capsys: Capture) -> None:
    shop.run()
    (shop.home / "work").rename(shop.home / "elsewhere")
    (shop.home / "data" / "bodies").unlink()
    assert shop.run(list=True) == 0, "nothing is stale"
    shop.code["code.of.y"] = "edited"
    capsys.readouterr()
    assert shop.run() == 1
    assert capsys.readouterr().err == "0 made, 1 blocked (y: needs runs/y-0, which cannot be made), 5 fresh\n"


@pytest.mark.parametrize(
    ("script", "why"),
    [
        ("echo the reason >&2; exit 2", "the reason"),
        ("exit 3", "exit status 3"),
        ("true", "the command ended well, but its product is not there"),
    ],
)
def test_a_step_that_fails_stops_those_that_need_it(shop: Workshop, capsys: Capture, script: str, why: str) -> None:
    shop.steps[1] = a_training("runs/x-0", script)
    assert shop.run() == 1
    lines = capsys.readouterr().err.splitlines()
    assert f"failed  runs/x-0: {why} ({shop.home}/work/logs/runs.x-0.log)" in lines
    assert lines[-1] == "4 made, 1 failed (runs/x-0), 1 not made (x: never made), 4 fresh"
    assert [*shop.results()] == ["y"]
    shop.steps[1] = a_training("runs/x-0")
    assert shop.run() == 0


def test_a_result_that_was_not_written_is_a_failure(shop: Workshop, capsys: Capture) -> None:
    shop.steps[3] = a_result("x", "runs/x-0", "true")
    assert shop.run("x") == 1
    assert "failed  x: the command ended well, but made no results/x.json" in capsys.readouterr().err


def test_a_program_that_is_not_there_is_a_failure(shop: Workshop, capsys: Capture) -> None:
    shop.steps[1] = dataclasses.replace(shop.steps[1], words=("no-such-program", "sets/a", "runs/x-0"))
    assert shop.run() == 1
    assert "failed  runs/x-0: cannot run no-such-program: No such file or directory" in capsys.readouterr().err
    assert [*shop.results()] == ["y"]


def test_an_interrupted_step_carries_on(shop: Workshop, capsys: Capture, interruptible: None) -> None:
    cut = 'if [ -d "$1" ]; then echo >> "$1/starts"; else mkdir -p "$1"; kill -INT $PPID; exec sleep 30; fi; '
    shop.steps[1] = a_training("runs/x-0", cut + TRAINING)
    with pytest.raises(KeyboardInterrupt):
        shop.run()
    assert "stopped runs/x-0\n" in capsys.readouterr().err
    assert shop.run() == 0
    assert "sets/a" not in ended(capsys), "finished steps stay finished"
    assert (shop.home / "work" / "runs" / "x-0" / "starts").exists()


def test_an_interrupted_step_of_other_code_starts_anew(shop: Workshop, interruptible: None) -> None:
    cut = 'if [ ! -e stopped ]; then mkdir -p "$1"; touch "$1/half" stopped; kill -INT $PPID; exec sleep 30; fi; '
    shop.steps[1] = a_training("runs/x-0", cut + TRAINING)
    with pytest.raises(KeyboardInterrupt):
        shop.run()
    shop.code["code.of.runs/x-0"] = "edited"
    assert shop.run() == 0
    assert not (shop.home / "work" / "runs" / "x-0" / "half").exists()
    assert (shop.home / "work" / "replaced" / "runs" / "x-0.1" / "half").exists()


def test_steps_run_side_by_side_but_for_those_that_take_times(shop: Workshop, capsys: Capture) -> None:
    meet = 'touch "met-$2"; until [ -e "met-$3" ]; do sleep 0.05; done; '
    alone = 'if [ "$(ls busy-*)" ]; then exit 1; fi; touch busy-alone; sleep 0.1; rm busy-alone; '
    busy = 'if [ -e busy-alone ]; then exit 1; fi; touch "busy-$2"; ' + meet + 'rm "busy-$2"; '
    runs = [
        shell(f"runs/{one}-0", "training", meet + TRAINING, "sets/a", f"runs/{one}-0", one, other)
        for one, other in ("xy", "yx")
    ]
    results = [
        a_result("x", "runs/x-0", busy.replace("$2", "of-x").replace("$3", "of-z") + RESULT),
        a_result("y", "runs/y-0", alone + RESULT, alone=True),
        a_result("z", "runs/x-0", busy.replace("$2", "of-z").replace("$3", "of-x") + RESULT),
    ]
    shop.steps = [a_set(), *runs, *results, a_page("x", "y", "z")]
    assert shop.run(jobs=2) == 0, capsys.readouterr().err


def test_of_several_at_a_time_the_longest_begins_first(shop: Workshop, capsys: Capture) -> None:
    shop.run()
    records = shop.home / "work" / "steps.json"
    content = json.loads(records.read_text())
    for name, seconds in (("runs/x-0", 10), ("runs/y-0", 20)):
        content["steps"][name]["seconds"] = seconds
        shop.code[f"code.of.{name}"] = "edited"
    records.write_text(json.dumps(content))
    capsys.readouterr()
    assert shop.run(jobs=2) == 0
    assert ended(capsys, "begun") == ["runs/y-0", "runs/x-0"]


def test_trainings_can_have_a_second_name(shop: Workshop) -> None:
    links = (("runs/other/z-0", "runs/x-0"), ("runs/box", "shipped"))
    script = (
        'test -s runs/box/network.safetensors; test -s runs/box/network.json; cat "$0/z-0/network.safetensors" > "$1"'
    )
    files = (("results/z.json", "z.json"),)
    step = shell("z", "results", script, "runs/other", "results/z.json", results=files, links=links)
    shop.steps = [a_set('mkdir -p "$1" && echo \'"made"\' > "$1/manifest.json"'), a_training("runs/x-0"), step]
    assert shop.run() == 0
    assert shop.results() == {"z": "made"}
    link = shop.home / "work" / "runs" / "other" / "z-0" / "network.safetensors"
    assert not link.parent.is_symlink(), "commands name a run after its folder"
    assert link.is_symlink() and not link.readlink().is_absolute()
    assert {*shop.records()["z"]["inputs"]} == {"runs/x-0", "shipped"}


def test_a_link_never_replaces_a_network(shop: Workshop, capsys: Capture) -> None:
    shop.steps[3] = a_result("x", "runs/x-0", links=(("runs/other", "runs/x-0"),))
    other = shop.home / "work" / "runs" / "other" / "network.safetensors"
    other.parent.mkdir(parents=True)
    other.touch()
    assert shop.run("x") == 1
    assert "runs/other/network.safetensors must be a link to" in capsys.readouterr().err


def test_patterns_choose_steps_and_what_they_need(shop: Workshop, capsys: Capture) -> None:
    assert shop.run("x", "runs/x*") == 0
    assert ended(capsys) == ["sets/a", "runs/x-0", "x"]
    with pytest.raises(BadConfig, match=r"--only nothing\* matches no step"):
        shop.run("nothing*")


def test_accepted_products_are_fresh(shop: Workshop, capsys: Capture) -> None:
    shop.run()
    shop.code = {f"code.of.{step.name}": "edited" for step in shop.steps}
    before = shop.records()["x"]
    capsys.readouterr()
    assert shop.run(accept=True) == 0
    assert shop.run() == 0
    assert capsys.readouterr().err == "0 made, 6 fresh\n"
    after = shop.records()["x"]
    assert after["code"] == "edited" and before["code"] == "code"
    assert all(after[name] == before[name] for name in ("commit", "hardware", "seconds", "made"))


def test_in_a_fresh_checkout_recorded_sets_and_trainings_are_accepted_as_they_were(
    shop: Workshop, capsys: Capture
) -> None:
    shop.run()
    (shop.home / "work").rename(shop.home / "elsewhere")
    shop.code = {f"code.of.{step.name}": "edited" for step in shop.steps}
    before = shop.records()
    assert shop.run(list=True) == 1
    assert shop.run(accept=True) == 0
    after = shop.records()
    assert all(after[name]["code"] == "edited" for name in after)
    assert all(after[name]["made"] == before[name]["made"] for name in before)
    capsys.readouterr()
    assert shop.run(list=True) == 0
    assert "3 absent, 3 fresh" in capsys.readouterr().out


def test_what_is_not_there_or_of_unknown_inputs_cannot_be_accepted(shop: Workshop) -> None:
    with pytest.raises(BadConfig, match="cannot accept sets/a, which is not there"):
        shop.run("sets/a", accept=True)
    (shop.home / "results" / "x.json").write_text("{}")
    with pytest.raises(BadConfig, match="cannot accept x: runs/x-0, which it reads, has no record; accept it first"):
        shop.run("x", accept=True)
    set_folder = shop.home / "work" / "sets" / "a"
    set_folder.mkdir(parents=True)
    (set_folder / "manifest.json").write_text("bodies")
    (shop.home / "data" / "bodies").unlink()
    with pytest.raises(BadConfig, match="cannot accept sets/a: data/bodies, which it reads, is not there"):
        shop.run("sets/a", accept=True)


def test_one_command_at_a_time_uses_a_work_folder(shop: Workshop) -> None:
    work = shop.home / "work"
    work.mkdir()
    with (work / ".lock").open("ab") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(BadConfig, match=f"another tools/bench all is at work in {work}"):
            shop.run()
        assert shop.run(list=True) == 1, "which a list does not need"


def test_folders_that_do_not_fit_are_one_line(shop: Workshop) -> None:
    (shop.home / "work").touch()
    with pytest.raises(BadConfig, match="cannot make the folder .*: "):
        shop.run()
    with pytest.raises(BadConfig, match="--jobs must be"):
        shop.run(jobs=0)
    (shop.home / "results").rmdir()
    with pytest.raises(BadConfig, match="--results must be a folder, found"):
        shop.run()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is not JSON"),
        ("[]", "must hold a JSON object"),
        ('{"steps": {"x": {"made": {}}}}', "holds no records of steps: "),
        ('{"steps": 1}', "holds no records of steps: "),
    ],
)
def test_records_that_cannot_be_read_are_one_line(shop: Workshop, text: str, message: str) -> None:
    (shop.home / "results" / "steps.json").write_text(text)
    with pytest.raises(BadConfig, match=rf"steps\.json {message}"):
        shop.run(list=True)
