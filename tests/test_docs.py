"""The documentation: it builds without a warning, asks for nothing outside, and what it names is there."""

from __future__ import annotations

import ast
import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import dualslam
from dualslam.core.config.problems import all_paths
from dualslam.core.config.settings import Config

ROOT = Path(__file__).resolve().parent.parent
PAGES = [*sorted((ROOT / "docs").rglob("*.md")), ROOT / "README.md"]
CODE = re.compile(r"`((?:dualslam|frontends|backend|tools|tests|notebooks|benchmarks|docs)/[\w./-]*)(?:::(\w+))?`")


@pytest.fixture(scope="module")
def hooks() -> ModuleType:
    spec = importlib.util.spec_from_file_location("docs_hooks", ROOT / "tools" / "docs_hooks.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("docs") / "site"
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(out)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return out


@pytest.mark.slow
def test_it_builds_and_asks_for_nothing_outside(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 10
    for page in pages:
        fetched = re.findall(r"<(?:script|link|img|iframe)\b[^>]*(?:src|href)=\"?([^\s\">]+)", page.read_text())
        assert not [url for url in fetched if re.match(r"(https?:)?//", url)]


@pytest.mark.slow
def test_the_script_of_the_dark_mode_finds_its_elements(site: Path) -> None:
    named = re.findall(r"getElementById\('([\w-]+)'\)", (site / "js" / "darkmode.js").read_text())
    assert named
    page = (site / "index.html").read_text()
    assert [name for name in named if not re.search(rf'id="?{name}\b', page)] == []


def test_every_public_name_is_on_one_reference_page() -> None:
    pages = [page.read_text() for page in (ROOT / "docs" / "reference").glob("*.md")]
    shown = [name for page in pages for name in re.findall(r"^::: dualslam\.(\w+)$", page, re.MULTILINE)]
    elsewhere = {"Config", "__version__"}  # the page of all settings; a string
    assert sorted(shown) == sorted({*dualslam.__all__} - elsewhere)


@pytest.mark.slow
def test_every_field_of_the_configuration_is_explained(site: Path) -> None:
    text = (site / "configuration.html").read_text()
    for path in all_paths(Config):
        section = any(other.startswith(f"{path}.") for other in all_paths(Config))
        assert (f">{path}</h" if section else f"<code>{path}</code>") in text


@pytest.mark.slow
def test_equations_are_drawn_and_code_is_left_alone(site: Path, hooks: ModuleType) -> None:
    assert (site / "theory.html").read_text().count(
        '<math xmlns="http://www.w3.org/1998/Math/MathML" display="block"'
    ) > 10
    for page in site.rglob("*.html"):
        assert not re.search(r"equation\d+ofpage|\\(?:frac|sum|left|begin)\b", page.read_text())
    page = type("Page", (), {"meta": {}})
    text = hooks.on_page_markdown("`$HOME` and $x$, 3 $ and 4 $\n```\n$y$\n```", page=page)
    assert text == "`$HOME` and equation0ofpage, 3 $ and 4 $\n```\n$y$\n```"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_what_it_names_in_the_code_is_there(page: Path) -> None:
    for path, name in CODE.findall(page.read_text()):
        assert (ROOT / path).exists(), path
        if name:
            tree = ast.parse((ROOT / path).read_text())
            defined = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)}
            assert name in defined, f"{path}::{name}"


def test_every_note_is_listed_once() -> None:
    listed = re.findall(r"\(notes/([\w-]+\.md)\)", (ROOT / "docs" / "findings.md").read_text())
    assert sorted(listed) == sorted(page.name for page in (ROOT / "docs" / "notes").iterdir())


@pytest.mark.parametrize("repository", ["", "owner/name"])
def test_the_index_s_readme_has_no_relative_links(repository: str) -> None:
    spec = importlib.util.spec_from_file_location("readme_hook", ROOT / "tools" / "readme_hook.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    text = module.for_index((ROOT / "README.md").read_text(), repository, "v1.0.0")
    targets = re.findall(r"\]\(([^)\s]+)\)", text)
    assert all(target.startswith("https://") for target in targets)
    ours = [target for target in targets if target.startswith("https://github.com/owner/name/")]
    assert bool(ours) == bool(repository)
    for target in ours:
        kind, path = target.removeprefix("https://github.com/owner/name/").split("/v1.0.0/")
        assert kind in ("blob", "raw")
        assert (ROOT / path.partition("#")[0]).exists(), path
