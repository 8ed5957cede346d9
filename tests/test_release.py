"""What releases are made with: workflows, the container's file, lists of exact versions."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from folders import ROOT, TESTS
from packaging.requirements import Requirement

WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
DOCKER = ROOT / "tools" / "docker"


def steps(workflow: Path) -> list[dict[str, Any]]:
    jobs = yaml.safe_load(workflow.read_text())["jobs"].values()
    return [step for job in jobs for step in job["steps"]]


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_run_commands_that_developers_have(workflow: Path) -> None:
    (phony,) = re.findall(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    run = [re.match(r"make (\S+)", step.get("run", "")) for step in steps(workflow)]
    targets = {found[1] for found in run if found}
    assert targets and targets <= set(phony.split())
    assert all(re.fullmatch(r"[\w-]+/[\w-]+@\S+", step["uses"]) for step in steps(workflow) if "uses" in step)


def test_the_workflow_of_tests_runs_them_all_on_every_python_that_is_claimed() -> None:
    job = yaml.safe_load((ROOT / ".github/workflows/tests.yml").read_text())["jobs"]["tests"]
    runs = [step.get("run", "").split() for step in job["steps"]]
    assert {"check", "test", "test-benches", "test-browser", "docs"} <= {
        words[1] for words in runs if words[:1] == ["make"]
    }
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    claimed = re.findall(r"Python :: (3\.\d+)", "\n".join(project["classifiers"]))
    assert job["strategy"]["matrix"]["python"] == claimed
    assert project["requires-python"] == f">={claimed[0]}"


def test_a_job_has_the_packages_that_benches_compare_with() -> None:
    """And runs every test that skips without them."""
    assert any(
        step.get("run", "").startswith("make test-rivals") for step in steps(ROOT / ".github/workflows/tests.yml")
    )
    target = re.search(r"^test-rivals: install\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert target is not None
    words = target[1].split()
    assert "tools/install_rivals" in words
    folders = tuple(f"{word}/" for word in words if word.startswith("tests/"))
    skips = re.compile(r'importorskip\("(sklearn|transformers|litdata|streaming|cv2)|is not installed: \{error')
    files = [path for path in TESTS.rglob("test_*.py") if path != Path(__file__) and skips.search(path.read_text())]
    assert len(files) > 2 and all(path.relative_to(ROOT).as_posix().startswith(folders) for path in files)


def test_data_that_are_not_in_the_repository_are_found_in_one_place() -> None:
    """By the fixture `shared_data`, which skips: a test of its own path would be skipped, or fail, unseen."""
    users = {path.relative_to(TESTS).as_posix() for path in TESTS.rglob("*.py") if "SHARED_DATA" in path.read_text()}
    assert users == {"conftest.py", "helpers/folders.py", "test_release.py"}


def test_publishing_may_do_no_more_than_it_needs() -> None:
    workflow = yaml.safe_load((ROOT / ".github/workflows/publish.yml").read_text())
    assert workflow["permissions"] == {"contents": "read"}
    assert workflow["jobs"]["publish"]["permissions"] == {"id-token": "write"}
    assert "permissions" not in workflow["jobs"]["build"]
    assert not any("secrets." in str(step) for step in steps(ROOT / ".github/workflows/publish.yml"))


def test_the_container_copies_what_is_there_and_not_ignored() -> None:
    copied = re.findall(r"^COPY (?!--from)(.*) \S+$", (DOCKER / "Dockerfile").read_text(), re.MULTILINE)
    sources = {name for names in copied for name in names.split()}
    allowed = re.findall(r"^!(.*)$", (DOCKER / "Dockerfile.dockerignore").read_text(), re.MULTILINE)
    assert sources == set(allowed)
    assert all((ROOT / name).exists() for name in sources)


def test_the_container_ends_without_root() -> None:
    last = (DOCKER / "Dockerfile").read_text().rpartition("FROM ")[2]
    assert re.search(r"^USER (?!root|0)\w+$", last, re.MULTILINE) and '\nENTRYPOINT ["bodyseg", "shard"]\n' in last


@pytest.mark.parametrize("name", ["requirements.lock", "requirements-release.lock"])
def test_versions_are_exact(name: str) -> None:
    lines = [line for line in (ROOT / "tools" / name).read_text().splitlines() if not line.startswith("#")]
    exact = re.compile(r'[\w.-]+==[\w.]+(; (python_version [<>]=? "3\.\d+"|sys_platform [\w=!" ]+))?')
    assert len(lines) > 40 and all(exact.fullmatch(line) for line in lines)


def test_what_there_is_no_build_of_is_not_asked_for_on_arm() -> None:
    """pip would install nothing, not even the default renderer, which needs no embreex."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    locked = [line for line in (ROOT / "tools/requirements.lock").read_text().splitlines() if line[0] != "#"]
    for lines in (extras["render"], locked):
        (embreex,) = (need for need in map(Requirement, lines) if need.name == "embreex")
        assert embreex.marker is not None
        for machine, expected in (("x86_64", True), ("aarch64", False)):
            assert embreex.marker.evaluate({"sys_platform": "linux", "platform_machine": machine}) is expected
        assert embreex.marker.evaluate({"sys_platform": "darwin", "platform_machine": "arm64"})


def test_what_builds_and_checks_a_release_is_listed() -> None:
    listed = (ROOT / "tools" / "requirements-release.lock").read_text()
    assert all(f"\n{name}==" in listed for name in ("build", "twine", "pip_audit"))


def test_the_citation_is_of_this_version_and_of_the_paper() -> None:
    told = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert (str(told["version"]), told["license"]) == (project["version"], project["license"])
    (paper,) = told["references"]
    assert paper["type"] == "conference-paper" and paper["authors"] and paper["title"].startswith("Increasing the")
