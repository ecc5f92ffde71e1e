"""A budget of sizes: limits in a TOML file, compared with the sizes of today.

Each number has a limit and a slack, so that a small change needs no edit. A limit is raised by a line in `raises`,
which names the reason.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SLACK = 0.005
"""Share of a limit by which a number may exceed it: 236 lines of the package, no setting."""
ROOM_SLACK, MIN_ROOM_SLACK = 0.02, 40
"""Share and lines by which a room may exceed its limit, whichever is more: a small feature."""

HEADER = """\
# Sizes that must not grow unseen. `make check` compares them: python tools/structure.py --budget tools/budget.toml
# Lower the limits to today's sizes with --update; raise those that are exceeded with --update --why "REASON".
"""


@dataclass(frozen=True)
class Raise:
    """A line that raises limits, by name, for one reason."""

    why: str
    by: dict[str, int]


@dataclass(frozen=True)
class Budget:
    """Limits by name, `lines.ROOM` for those of rooms, and what raised them."""

    limits: dict[str, int]
    raises: tuple[Raise, ...] = ()

    def limit(self, name: str) -> int:
        """Return the limit of a number, with what raised it; 0 where it has none."""
        return self.limits.get(name, 0) + sum(line.by.get(name, 0) for line in self.raises)

    def excess(self, sizes: dict[str, int]) -> dict[str, int]:
        """Return by how much numbers exceed their limits, of those that do by more than their slack."""
        over = {name: size - self.limit(name) for name, size in sizes.items()}
        return {name: by for name, by in over.items() if by > slack_of(name, self.limit(name))}

    def lowered(self, sizes: dict[str, int]) -> Budget:
        """Return a budget without what is to spare; the latest raise is shortened first."""
        spare = {name: max(self.limit(name) - size, 0) for name, size in sizes.items()}
        raises: list[Raise] = []
        for line in reversed(self.raises):
            kept = {}
            for name, by in line.by.items():
                taken = min(spare.get(name, by), by)
                spare[name] = spare.get(name, 0) - taken
                kept[name] = by - taken
            if any(kept.values()):
                raises.insert(0, Raise(line.why, {name: by for name, by in kept.items() if by}))
        limits = {name: self.limits.get(name, 0) - spare[name] for name in sizes}
        return Budget(limits, tuple(raises))

    def raised(self, sizes: dict[str, int], why: str) -> Budget:
        """Return a budget with one more line, which allows what is exceeded now."""
        by = self.excess(sizes)
        return Budget(self.limits, (*self.raises, Raise(why, by))) if by else self


def slack_of(name: str, limit: int) -> int:
    """Return by how much a number may exceed its limit."""
    return max(int(ROOM_SLACK * limit), MIN_ROOM_SLACK) if name.startswith("lines.") else int(SLACK * limit)


def sentence_on(name: str, size: int, limit: int) -> str:
    """Return what is exceeded, and what to do about it."""
    allowed = f"{limit} + {slack} slack" if (slack := slack_of(name, limit)) else str(limit)
    return f'{name} is {size}, above its limit of {allowed}: shrink it, or raise it with --update --why "REASON".'


def read(path: Path) -> Budget:
    """Read a budget.

    Raises
    ------
    SystemExit
        With one sentence that names the file and what is wrong in it.
    """
    try:
        data = tomllib.loads(_without_twins(path.read_text(encoding="utf-8")))
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise SystemExit(f"{path} cannot be read: {error}") from error
    raises = []
    for line in data.pop("raises", []):
        why = str(line.pop("why", "")).strip()
        if not why:
            raise SystemExit(f"{path}: a line of `raises` has no `why`: {line}")
        raises.append(Raise(why, _numbers(path, line)))
    lines = {f"lines.{room}": n for room, n in data.pop("lines", {}).items()}
    return Budget(_numbers(path, data | lines), tuple(raises))


def write(budget: Budget, path: Path) -> None:
    """Write a budget with one line a number and one a raise, so that changes of several people merge."""
    rooms = sorted(name for name in budget.limits if name.startswith("lines."))
    out = [HEADER]
    out += [f"{name} = {n}" for name, n in budget.limits.items() if name not in rooms]
    out += ["", "raises = ["]
    for line in budget.raises:
        why = line.why.replace("\\", "\\\\").replace('"', '\\"')
        by = ", ".join(f'"{name}" = {n}' for name, n in line.by.items())
        out.append(f'  {{ {by}, why = "{why}" }},')
    out += ["]", "", "[lines]"]
    out += [f'"{name.removeprefix("lines.")}" = {budget.limits[name]}' for name in rooms]
    path.write_text("\n".join(out) + "\n", encoding="utf-8")


def _without_twins(text: str) -> str:
    """Return a budget of which a merge has kept both sides of a limit: the larger one holds."""
    lines: dict[str, str] = {}
    for n, line in enumerate(text.splitlines()):
        name, _, value = line.partition(" = ")
        if not value.isdigit():
            lines[str(n)] = line
        elif name not in lines or int(value) > int(lines[name].partition(" = ")[2]):
            lines[name] = line
    return "\n".join(lines.values())


def _numbers(path: Path, data: dict[str, Any]) -> dict[str, int]:
    for name, value in data.items():
        if type(value) is not int:
            raise SystemExit(f"{path}: {name} is {value!r}, and must be a whole number.")
    return data
