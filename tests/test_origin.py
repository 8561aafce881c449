"""Where results were made: commit and machine, as records tell them."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from magenv import origin


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of a program."""
    (tmp_path / "magenv").mkdir()
    (tmp_path / "magenv" / "dipole.py").write_text("MU = 1\n")
    monkeypatch.setattr(origin, "_ROOT", tmp_path)
    return tmp_path


def git(folder: Path, *arguments: str) -> str:
    author = ["-c", "user.name=Nobody", "-c", "user.email=nobody@example.org"]
    done = subprocess.run(["git", "-C", folder, *author, *arguments], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_the_commit_is_told_and_whether_the_program_differs_from_it(program: Path) -> None:
    git(program, "init", "--quiet")
    assert origin.commit() == "unknown", "nothing is committed"
    git(program, "add", ".")
    git(program, "commit", "--quiet", "--message", "All")
    head = git(program, "rev-parse", "HEAD")[:12]
    assert origin.commit() == head
    (program / "docs").mkdir()
    (program / "docs" / "results.md").touch()
    assert origin.commit() == head, "results are no part of the program"
    (program / "magenv" / "dipole.py").write_text("MU = 2\n")
    assert origin.commit() == f"{head}+changes"


def test_a_program_in_no_repository_of_its_own_has_no_commit(program: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert origin.commit() == "unknown"
    git(program, "init", "--quiet")
    git(program, "add", ".")
    git(program, "commit", "--quiet", "--message", "Another project")
    monkeypatch.setattr(origin, "_ROOT", program / "magenv")
    assert origin.commit() == "unknown"
    monkeypatch.setenv("PATH", "")
    assert origin.commit() == "unknown"


def test_the_machine_is_told_by_its_processor_alone() -> None:
    told = origin.machine()
    assert told.startswith(origin.cpu())
    assert " cores, " in told
    assert "\n" not in told
