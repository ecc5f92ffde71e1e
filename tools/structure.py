"""Print how the house is built: rooms, arrows between them, circles, and lines by room.

    python tools/structure.py [--root CHECKOUT]

A room is a package directly inside `dualslam`, `frontends` or `backend`; a loose module counts as one of its own. An
arrow goes from a room to another that it imports; imports for type checking alone do not count. A circle is a set of
rooms that import each other, directly or through others.
"""

from __future__ import annotations

import argparse
import ast
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

TOPS = ("dualslam", "frontends", "backend")


def main() -> None:
    """Read the sources, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, default=Path(__file__).resolve().parent.parent)
    root = parser.parse_args().root
    lines: Counter[str] = Counter()
    arrows: defaultdict[str, set[str]] = defaultdict(set)
    modules = {path: module_of(path.relative_to(root)) for path in sources(root)}
    known = set(modules.values())
    for path, module in modules.items():
        text = path.read_text(encoding="utf-8")
        lines[room_of(module, known)] += text.count("\n")
        for name in imports(ast.parse(text)):
            target = room_of(name, known)
            if name.split(".")[0] in TOPS and target != room_of(module, known) and target != "dualslam":
                arrows[room_of(module, known)].add(target)
    rooms = sorted(lines, key=lambda room: -lines[room])
    n_arrows = sum(len(targets) for targets in arrows.values())
    out = [f"{len(rooms)} rooms, {n_arrows} arrows, {sum(lines.values())} lines; circles: {circles(rooms, arrows)}", ""]
    out += ["| room | lines | imports |", "|---|---|---|"]
    out += [f"| {room} | {lines[room]} | {', '.join(sorted(arrows[room])) or '-'} |" for room in rooms]
    sys.stdout.write("\n".join(out) + "\n")


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


def circles(rooms: list[str], arrows: dict[str, set[str]]) -> str:
    """Return the rooms that can reach themselves, by circle."""
    at = {room: i for i, room in enumerate(rooms)}
    pairs = [(at[a], at[b]) for a, targets in arrows.items() for b in targets if b in at]
    one, other = np.array(pairs or [(0, 0)]).T
    n = len(rooms)
    matrix = coo_matrix((np.ones(len(one)), (one, other)), (n, n))
    _, label = connected_components(matrix, connection="strong")
    groups = [[rooms[i] for i in np.flatnonzero(label == k)] for k in np.unique(label)]
    return "; ".join(" - ".join(group) for group in groups if len(group) > 1) or "none"


if __name__ == "__main__":
    main()
