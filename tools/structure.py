"""Print the structure of the package: rooms, arrows between them, circles, and lines by room.

    python tools/structure.py [--root CHECKOUT] [--budget FILE [--update [--why REASON]]]

A room is a package directly inside `dualslam`, `frontends` or `backend`; a loose module counts as one of its own. An
arrow goes from a room to another that it imports; imports for type checking alone do not count. A circle is a set of
rooms that import each other, directly or through others.

With `--budget` it compares the sizes of the package and its prose with the limits of a file. It exits with status 1,
and one sentence for each, where any is exceeded. `--update` lowers the limits to the sizes of today; with `--why` it
raises those that are exceeded instead.
"""

from __future__ import annotations

import argparse
import ast
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import budget
import counts
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

TOPS = ("dualslam", "frontends", "backend")
APART = {"dualslam.lab", "dualslam.testing"}
"""Rooms that the package's sum leaves out: the failure lab and the support of tests."""
_IN_DUALSLAM = "system build map atlas linking recovery places workers"
ALGORITHM = {"frontends", "backend", *(f"dualslam.{name}" for name in _IN_DUALSLAM.split())}
DOCUMENTS = ("docs", "README.md", "CONTRIBUTING.md", "CHANGELOG.md")
WORDS = Path(__file__).resolve().parent / "words.txt"
"""Private words that the prose should avoid, one a line."""


@dataclass(frozen=True)
class Structure:
    """Lines by room, what each room imports, and the rooms that import each other."""

    lines: Counter[str]
    arrows: dict[str, set[str]]
    circles: list[list[str]]

    @property
    def n_arrows(self) -> int:
        """The number of pairs of rooms of which one imports the other."""
        return sum(map(len, self.arrows.values()))


def main() -> int:
    """Read the sources, and print their structure or compare it with a budget; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, default=Path(__file__).resolve().parent.parent)
    parser.add_argument("--budget", type=Path, help="compare with the limits in this file")
    parser.add_argument("--update", action="store_true", help="lower the limits to the sizes of today")
    parser.add_argument("--why", help="with --update: raise the limits that are exceeded, for this reason")
    args = parser.parse_args()
    if (args.update and not args.budget) or (args.why is not None and not args.update):
        parser.error("--update needs --budget, and --why needs --update")
    if args.why is not None and not args.why.strip():
        parser.error("--why needs a reason")
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in sources(args.root)}
    structure = structure_of(args.root, trees)
    if args.budget is None:
        sys.stdout.write(table_of(structure))
        return 0
    return compare(sizes_of(args.root, trees, structure), args.budget, args.update, args.why)


def compare(sizes: dict[str, int], path: Path, update: bool = False, why: str | None = None) -> int:
    """Compare sizes with a budget, update it on request, and return the exit status."""
    limits = budget.read(path)
    if update:
        limits = limits.lowered(sizes) if why is None else limits.raised(sizes, why)
        budget.write(limits, path)
    exceeded = limits.excess(sizes)
    for name in exceeded:
        sys.stderr.write(f"{path}: {budget.sentence_on(name, sizes[name], limits.limit(name))}\n")
    return 1 if exceeded else 0


def structure_of(root: Path, trees: dict[Path, ast.Module]) -> Structure:
    """Return the rooms of a checkout, from its parsed sources."""
    lines: Counter[str] = Counter()
    arrows: defaultdict[str, set[str]] = defaultdict(set)
    modules = {path: module_of(path.relative_to(root)) for path in trees}
    known = set(modules.values())
    for path, module in modules.items():
        room = room_of(module, known)
        lines[room] += path.read_text(encoding="utf-8").count("\n")
        for name in imports(trees[path]):
            target = room_of(name, known)
            if name.split(".")[0] in TOPS and target not in (room, "dualslam"):
                arrows[room].add(target)
    return Structure(lines, dict(arrows), circles(list(lines), arrows))


def sizes_of(root: Path, trees: dict[Path, ast.Module], structure: Structure) -> dict[str, int]:
    """Return all sizes that a budget limits, by name."""
    modules = {path: module_of(path.relative_to(root)) for path in trees}
    rooms = {path: room_of(module, set(modules.values())) for path, module in modules.items()}
    steps = [tree for path, tree in trees.items() if rooms[path] in ALGORITHM]
    config = [tree for path, tree in trees.items() if path.is_relative_to(root / "dualslam" / "core" / "config")]
    prose = [text for path in prose_files(root) for text in counts.prose_of(path)]
    return {
        "package": sum(n for room, n in structure.lines.items() if room not in APART),
        "algorithm": sum(n for room, n in structure.lines.items() if room in ALGORITHM),
        "literals": sum(map(counts.count_literals, steps)),
        "constants": sum(map(counts.count_constants, steps)),
        "settings": counts.count_settings(config),
        "rooms": len(structure.lines),
        "arrows": structure.n_arrows,
        "circles": len(structure.circles),
        "long_sentences": counts.count_long_sentences(prose),
        "private_words": counts.count_words(prose, WORDS.read_text(encoding="utf-8").splitlines()),
        **{f"lines.{room}": n for room, n in structure.lines.items()},
    }


def table_of(structure: Structure) -> str:
    """Return the rooms as a Markdown table, the largest first."""
    lines, arrows = structure.lines, structure.arrows
    joined = "; ".join(" - ".join(group) for group in structure.circles) or "none"
    out = [f"{len(lines)} rooms, {structure.n_arrows} arrows, {sum(lines.values())} lines; circles: {joined}", ""]
    out += ["| room | lines | imports |", "|---|---|---|"]
    out += [f"| {room} | {n} | {', '.join(sorted(arrows.get(room, ()))) or '-'} |" for room, n in lines.most_common()]
    return "\n".join(out) + "\n"


def prose_files(root: Path) -> Iterator[Path]:
    """Yield the files whose prose counts: the package, its pages, and the documents beside it."""
    yield from sources(root)
    for name in DOCUMENTS:
        yield from sorted((root / name).rglob("*.md")) if (root / name).is_dir() else [root / name]


def sources(root: Path) -> Iterator[Path]:
    """Yield every module once: links inside the package lead to folders that are read anyway."""
    for top in TOPS:
        for path in sorted((root / top).rglob("*.py")):
            if not any(parent.is_symlink() for parent in path.parents):
                yield path


def module_of(path: Path) -> str:
    """Return a module's name as it is imported in this checkout."""
    parts = [*path.parts[:-1], *([] if path.stem == "__init__" else [path.stem])]
    return ".".join(parts)


def room_of(module: str, known: set[str]) -> str:
    """Return the room that a module, or what is imported from one, is in."""
    parts = module.split(".")
    if parts[:1] == ["dualslam"] and parts[1:2] and parts[1] in ("frontends", "backend"):
        parts = parts[1:]
    if parts[0] != "dualslam":
        return parts[0]
    return ".".join(parts[:2]) if len(parts) > 1 and f"dualslam.{parts[1]}" in known else "dualslam"


def imports(tree: ast.Module) -> Iterator[str]:
    """Yield what is imported, but for type checking."""
    pending: list[ast.AST] = [tree]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            pending += node.orelse
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        pending += ast.iter_child_nodes(node)


def circles(rooms: list[str], arrows: dict[str, set[str]]) -> list[list[str]]:
    """Return the groups of rooms that import each other, directly or through others."""
    at = {room: i for i, room in enumerate(rooms)}
    pairs = [(at[a], at[b]) for a, targets in arrows.items() for b in targets if b in at]
    one, other = np.array(pairs or [(0, 0)]).T
    n = len(rooms)
    matrix = coo_matrix((np.ones(len(one)), (one, other)), (n, n))
    _, label = connected_components(matrix, connection="strong")
    groups = [[rooms[i] for i in np.flatnonzero(label == k)] for k in np.unique(label)]
    return [group for group in groups if len(group) > 1]


if __name__ == "__main__":
    sys.exit(main())
