"""Rows of the board as the page plays them: the test episodes of each row's first run at its largest budget."""

from __future__ import annotations

import json
from itertools import accumulate
from pathlib import Path
from typing import Any

from imagine_bench import registry
from imagine_bench.interfaces import Rules, TaskSpec

BOARD = Path(__file__).parents[1] / "board" / "rows"
FAMILIES = ("arrows", "arrow_puzzle")
"""Tasks whose scenes the page has."""


def _after(rules: Rules, state: tuple[int, ...], action: int) -> tuple[int, ...]:
    (outcome,) = rules.outcomes(state, action)
    return outcome.macrostate


def converted(card: dict[str, Any], logs: list[dict[str, Any]]) -> dict[str, object] | None:
    """A row for the page; None of a task that it has no scene of, or one whose results are drawn by chance.

    The states after each macro-action follow from the rules, since nothing is drawn.
    """
    if "motions" in card.get("format", ""):  # rows of continuous control have no macro-actions
        return None
    spec: TaskSpec = registry.task(card["protocol"]["task"])
    rules = spec.rules
    world = getattr(rules, "world", None)
    if not spec.id.startswith(FAMILIES) or world.slip or world.goal_change:
        return None
    first = card["vouched"][0]["seed"]
    which = max(
        (place for place, each in enumerate(card["vouched"]) if each["seed"] == first),
        key=lambda place: card["vouched"][place]["episodes"],
    )
    figures = card["vouched"][which]
    log = logs[which]
    episodes = []
    for start, actions, solved in zip(log["starts"], log["actions"], log["solved"], strict=True):
        states = accumulate(actions, lambda state, action: _after(rules, state, action), initial=tuple(start))
        episodes.append({"start": start, "actions": actions, "states": list(states)[1:], "success": solved == "1"})
    agent = card["claimed"]["agent"]
    title = f"{agent}, {figures['episodes']} episodes: {figures['successes']} of {figures['test_episodes']} solved"
    return {"title": title, "world": spec.id, "episodes": episodes}


def write(folder: Path, board: Path = BOARD) -> None:
    """Write every row of a board into a folder, and ``index.json``: names and titles."""
    folder.mkdir(parents=True, exist_ok=True)
    index = []
    for path in sorted(board.glob("*/card.json")):
        episodes = path.with_name("episodes.json").read_text()
        row = converted(json.loads(path.read_text()), json.loads(episodes))
        if row is not None:
            index.append([path.parent.name, row["title"]])
            (folder / f"{path.parent.name}.json").write_text(json.dumps(row, separators=(",", ":")))
    (folder / "index.json").write_text(json.dumps(index))
