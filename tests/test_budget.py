"""The budget of sizes: what is counted, and when `make check` fails."""

from __future__ import annotations

import ast
import importlib
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

TOOLS = Path(__file__).resolve().parent.parent / "tools"


@pytest.fixture
def counts(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(TOOLS))
    return importlib.import_module("counts")


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    files = {
        "dualslam/__init__.py": '"""A package."""\n',
        "dualslam/core/config/__init__.py": "",
        "dualslam/core/config/settings.py": "class Part:\n    a: int = 3\n\n"
        "class Config:\n    part: Part\n    b: int = 4\n",
        "dualslam/map/__init__.py": "LIMIT = 7\n",
        "dualslam/lab/__init__.py": "from dualslam.map import LIMIT\n" * 50,
        "frontends/__init__.py": "from dualslam.map import LIMIT\n\nfactor = 0.5 * LIMIT\n",
        "backend/__init__.py": "",
        "docs/index.md": "Short.\n",
        **dict.fromkeys(("README.md", "CONTRIBUTING.md", "CHANGELOG.md"), "# Title\n"),
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def run(checkout: Path, monkeypatch: pytest.MonkeyPatch, *options: str) -> int:
    monkeypatch.syspath_prepend(str(TOOLS))
    budget = str(checkout / "budget.toml")
    monkeypatch.setattr(sys, "argv", ["structure.py", "--root", str(checkout), "--budget", budget, *options])
    return int(importlib.import_module("structure").main())


def limits(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(TOOLS))
    return importlib.import_module("budget").read(checkout / "budget.toml")


@pytest.fixture
def measured(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (checkout / "budget.toml").write_text("")
    assert run(checkout, monkeypatch, "--update", "--why", "the first sizes") == 0
    return checkout


def test_sizes_are_those_of_the_sources(measured: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    budget = limits(measured, monkeypatch)
    expected = {"settings": 2, "rooms": 5, "arrows": 2, "circles": 0, "literals": 2, "constants": 1, "private_words": 0}
    assert {name: budget.limit(name) for name in expected} == expected
    # A room within its slack of 40 lines needs no limit.
    assert budget.limit("lines.dualslam.lab") == 50
    assert budget.limit("package") == 11
    assert budget.limit("algorithm") == 4


def test_a_room_may_grow_by_its_slack_and_not_by_more(
    measured: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source = measured / "dualslam" / "lab" / "__init__.py"
    text = source.read_text()
    source.write_text(text + "\n" * 40)
    assert run(measured, monkeypatch) == 0
    source.write_text(text + "\n" * 41)
    capsys.readouterr()
    assert run(measured, monkeypatch) == 1
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 1
    assert "lines.dualslam.lab is 91, above its limit of 50 + 40 slack" in told[0]


def test_only_a_reason_raises_a_limit_and_what_shrinks_lowers_it(
    measured: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source = measured / "dualslam" / "map" / "__init__.py"
    source.write_text("LIMIT = 7\nOTHER = 8\n")
    assert run(measured, monkeypatch, "--update") == 1
    assert run(measured, monkeypatch, "--update", "--why", 'a "second" limit') == 0
    budget = limits(measured, monkeypatch)
    assert budget.raises[-1].why == 'a "second" limit'
    assert budget.raises[-1].by == {"package": 1, "algorithm": 1, "literals": 1, "constants": 1}
    assert run(measured, monkeypatch) == 0
    source.write_text("LIMIT = 7\n")
    assert run(measured, monkeypatch, "--update") == 0
    lowered = limits(measured, monkeypatch)
    assert lowered.limit("literals") == 2
    assert len(lowered.raises) == len(budget.raises) - 1


def test_of_two_limits_that_a_merge_has_kept_the_larger_holds(measured: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = measured / "budget.toml"
    path.write_text("literals = 7\nliterals = 9\nliterals = 8\n[lines]\n'frontends' = 3\n'frontends' = 2\n")
    budget = limits(measured, monkeypatch)
    assert budget.limit("literals") == 9
    assert budget.limit("lines.frontends") == 3


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("raises = [{ literals = 3 }]", "no `why`"),
        ("raises = [{ literals = 3, why = ' ' }]", "no `why`"),
        ("literals = 'many'", "must be a whole number"),
        ("literals = ", "cannot be read"),
    ],
)
def test_a_broken_budget_is_one_sentence(
    checkout: Path, monkeypatch: pytest.MonkeyPatch, text: str, problem: str
) -> None:
    (checkout / "budget.toml").write_text(text)
    with pytest.raises(SystemExit, match=problem):
        run(checkout, monkeypatch)


def test_literals_and_constants(counts: ModuleType) -> None:
    tree = ast.parse(
        "A = 1\nB, C = 3, -4.5\n\nclass K:\n    D: int = 7\n\ndef f(x=5):\n    E = 6\n    return True, x[0] * 2\n"
    )
    assert counts.count_literals(tree) == 5  # 3, 4.5, 7, 5, 6
    assert counts.count_constants(tree) == 3  # B, C, D


def test_prose_of_python_is_docstrings_comments_and_messages(counts: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "a.py"
    path.write_text(
        '"""One two three four five six."""\n\n# A comment over\n# two lines.\nx = "key"\ny = 1  # beside\n'
    )
    assert list(counts.prose_of(path)) == ["One two three four five six.", "A comment over two lines.", "beside"]


def test_prose_of_markdown_leaves_out_code_and_headings(counts: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "a.md"
    path.write_text("# Heading\n\nOne\ntwo.\n\n```\ncode\n```\n\n| a cell of six short words | b |\n")
    assert [text.strip() for text in counts.prose_of(path)] == ["One\ntwo.", "a cell of six short words"]


def test_long_sentences_and_private_words(counts: ModuleType) -> None:
    words = " ".join(["word"] * 25)
    prose = [f"{words}. {words} `{words}`.", f"{words} more."]
    assert counts.count_long_sentences(prose) == 2
    assert counts.count_words(["A bun. Buns, hot buns, unbuns."], ["bun", "buns", "hot buns"]) == 3
