"""Results cached in a file: lookup by query, invalidation, and several processes at once."""

from __future__ import annotations

import json
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import pytest
from benches.result_cache import FORMAT, ResultCache, network_identity

from bodyseg_data.core import BadConfig
from bodyseg_model.networks import build, save_network

FORK: Final = get_context("fork")  # its processes need not load PyTorch again
SUBJECT = {"weights": "abc"}
QUESTION = {"images": {"set": "x", "strengths": (1, 2.5)}, "count": 3}
RESULT = {"accuracy": 0.1 + 0.2, "subsets": {"A": None}}


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module that measures; no other test has one of this name, for each is read once a process."""
    name = f"measuring_{tmp_path.parent.name.replace('-', '_')}_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text("SHARE = 0.5\n")
    monkeypatch.syspath_prepend(tmp_path)
    return name


def test_a_result_comes_back_as_it_was(module: str, tmp_path: Path) -> None:
    file = tmp_path / "results.json"
    cache = ResultCache(file, SUBJECT, module)
    assert cache.get(QUESTION) is None and not file.exists()
    cache.put(QUESTION, RESULT)
    for known in (cache, ResultCache(file, SUBJECT, module)):
        assert known.get(QUESTION) == RESULT
        assert known.get({**QUESTION, "count": 4}) is None
    cache.put({**QUESTION, "count": 4}, {"accuracy": 1})
    assert cache.get(QUESTION) == RESULT


def test_a_result_is_of_one_subject(module: str, tmp_path: Path) -> None:
    file = tmp_path / "results.json"
    ResultCache(file, SUBJECT, module).put(QUESTION, RESULT)
    other = ResultCache(file, {"weights": "abd"}, module)
    assert other.get(QUESTION) is None
    other.put({"count": 1}, RESULT)
    assert len(json.loads(file.read_text())["results"]) == 1  # those about the network before are gone


def test_a_result_is_of_some_code(module: str, tmp_path: Path) -> None:
    """Asked by processes of their own, begun before this one reads the module's code: each reads it once."""
    file = tmp_path / "results.json"

    def answer(end: Connection) -> None:
        end.recv()
        end.send(ResultCache(file, SUBJECT, module).get(QUESTION))

    pipes = [FORK.Pipe() for _ in range(2)]
    processes = [FORK.Process(target=answer, args=(end,)) for _, end in pipes]
    for process in processes:
        process.start()

    def found(number: int) -> Any:
        pipes[number][0].send("ask")
        assert pipes[number][0].poll(60)
        return pipes[number][0].recv()

    ResultCache(file, SUBJECT, module).put(QUESTION, RESULT)
    (tmp_path / f"{module}.py").write_text("# Half.\nSHARE = 0.5\n")
    assert found(0) == RESULT
    (tmp_path / f"{module}.py").write_text("SHARE = 0.6\n")
    assert found(1) is None
    for process in processes:
        process.join(60)
        assert process.exitcode == 0


def test_results_of_two_ways_to_measure_do_not_replace_each_other(module: str, tmp_path: Path) -> None:
    file = tmp_path / "results.json"
    one = ResultCache(file, SUBJECT, module)
    two = ResultCache(file, SUBJECT, module, "bodyseg_data.core.errors")
    one.put(QUESTION, {"accuracy": 1})
    two.put(QUESTION, {"accuracy": 2})
    assert (one.get(QUESTION), two.get(QUESTION)) == ({"accuracy": 1}, {"accuracy": 2})
    one.put(QUESTION, {"accuracy": 3})
    assert len(json.loads(file.read_text())["results"]) == 2


def test_two_processes_lose_nothing(tmp_path: Path) -> None:
    file, count, names = tmp_path / "results.json", 15, ("first", "second")
    cache = ResultCache(file, SUBJECT, "bodyseg_data.core.errors")

    def write(name: str) -> None:
        for number in range(count):
            cache.put({"by": name, "number": number}, {"number": number})
            cache.put({"by": "both", "number": number}, {"number": number})

    processes = [FORK.Process(target=write, args=(name,)) for name in names]
    for process in processes:
        process.start()
    for process in processes:
        process.join(100)
        assert process.exitcode == 0
    cache = ResultCache(file, SUBJECT, "bodyseg_data.core.errors")
    for name in (*names, "both"):
        assert [cache.get({"by": name, "number": n}) for n in range(count)] == [{"number": n} for n in range(count)]
    assert sorted(path.name for path in tmp_path.iterdir()) == [".results.json.lock", "results.json"]


def altered(content: Any, **changes: Any) -> str:
    (key,) = content["results"]
    return json.dumps({**content, "results": {key: {**content["results"][key], **changes}}})


def test_a_result_that_was_altered_is_measured_again(module: str, tmp_path: Path) -> None:
    file = tmp_path / "results.json"
    cache = ResultCache(file, SUBJECT, module)
    cache.put(QUESTION, RESULT)
    whole = json.loads(file.read_text())
    (key,) = whole["results"]
    for text in (
        altered(whole, result={**RESULT, "accuracy": 0.9}),
        altered(whole, result=None),
        altered(whole, digest=None),
        altered(whole, code="other"),
        altered(whole, more=1),
        json.dumps({**whole, "results": {key: 5}}),
        json.dumps({**whole, "results": {key: {}}}),
    ):
        file.write_text(text)
        assert cache.get(QUESTION) is None
        cache.put(QUESTION, RESULT)
        assert json.loads(file.read_text()) == whole and cache.get(QUESTION) == RESULT


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"format": "another", "results": {}}', "holds no results of the format 'bodyseg cached results 1'"),
        (json.dumps({"format": FORMAT}), "move it away"),
        (json.dumps({"format": FORMAT, "results": []}), "move it away"),
        ('{"format": "bodyseg', "is not JSON"),
        ("[]", "must hold a JSON object"),
        ("", "is not JSON"),
    ],
)
def test_a_file_of_something_else_is_refused_and_kept(text: str, message: str, module: str, tmp_path: Path) -> None:
    file = tmp_path / "results.json"
    file.write_text(text)
    cache = ResultCache(file, SUBJECT, module)
    with pytest.raises(BadConfig, match=rf"results\.json.* {message}"):
        cache.get(QUESTION)
    with pytest.raises(BadConfig, match=rf"results\.json.* {message}"):
        cache.put(QUESTION, RESULT)
    assert file.read_text() == text


def test_a_file_that_cannot_be_written_is_named(module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(BadConfig, match=r"cannot lock .*results\.json\.lock: No such file or directory"):
        ResultCache(tmp_path / "nowhere" / "results.json", SUBJECT, module).put(QUESTION, RESULT)
    (tmp_path / "folder").mkdir()
    monkeypatch.setattr("bodyseg_data.files.access.part_beside", lambda path: tmp_path / "folder")
    with pytest.raises(BadConfig, match=r"cannot write .*taken\.json: (Is a directory|File exists)"):
        ResultCache(tmp_path / "taken.json", SUBJECT, module).put(QUESTION, RESULT)


def test_what_is_no_json_is_refused(module: str, tmp_path: Path) -> None:
    cache = ResultCache(tmp_path / "results.json", SUBJECT, module)
    with pytest.raises(ValueError, match="not JSON compliant"):
        cache.put(QUESTION, {"accuracy": float("nan")})
    assert list(tmp_path.glob("*.json")) == []


def test_the_identity_of_a_network(tmp_path: Path) -> None:
    settings = {"patch": 16, "widths": [8], "blocks": [0]}
    found = []
    for seed in (0, 0, 1):
        save_network(tmp_path / "network.safetensors", build("compact", settings, seed), "compact", {"seed": seed})
        found.append(network_identity(tmp_path))
        assert network_identity(tmp_path / "network.safetensors") == found[-1]
    assert found[0] == found[1] != found[2]
    assert found[0]["network"] == "compact" and found[0]["settings"]["patch"] == 16 and len(found[0]["weights"]) == 64
    (tmp_path / "network.safetensors").unlink()
    with pytest.raises(BadConfig, match=r"cannot read .*network\.safetensors"):
        network_identity(tmp_path)
