"""Rows of the board as the page plays them: the test episodes of each row's first run at its largest budget.

A row of continuous control is played again in physics. Each of its events is a macro-action of the rules, and is shown
as one.
"""

from __future__ import annotations

import json
from contextlib import closing
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from imagine_bench.tasks.continuous.env import MotionEnv
from imagine_bench_board import motion_rows, motions

from imagine_bench import registry
from imagine_bench.interfaces import Rules, TaskSpec

BOARD = Path(__file__).parents[1] / "board" / "rows"
ARROWS = ("arrows", "arrow_puzzle")
PICK_PLACE = "pick_place"
"""Beginnings of the names of tasks whose scenes the page has."""


def _after(rules: Rules, state: tuple[int, ...], action: int) -> tuple[int, ...]:
    (outcome,) = rules.outcomes(state, action)
    return outcome.macrostate


def has_scene(spec: TaskSpec) -> bool:
    """Whether the page has a scene of a task."""
    return spec.id.startswith((*ARROWS, PICK_PLACE))


def is_certain(spec: TaskSpec) -> bool:
    """Whether each macro-action of a task has one outcome, so that starts and actions say all."""
    world = getattr(spec.rules, "world", None)
    return spec.id.startswith(ARROWS) and not world.slip and not world.goal_change


def converted(card: dict[str, Any], logs: list[dict[str, Any]]) -> dict[str, object] | None:
    """A row of macro-actions for the page; None of a task that it has no scene of, or in which outcomes are drawn.

    The states after each macro-action follow from the rules.
    """
    spec: TaskSpec = registry.task(card["protocol"]["task"])
    rules = spec.rules
    if not is_certain(spec):
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


def _events(env: MotionEnv, row: motion_rows.MotionRow, test: int) -> dict[str, object]:
    """A test of continuous control, carried out again: the macro-action and the macrostate of each event.

    A fault is no macro-action, so the events end before it. They also end at the horizon of the macro-actions, since
    time alone ends continuous control. A test that is not reproducible counts as failed, wherever its events lead. An
    event may come some periods later than in the file.
    """
    motion = row.motions[test]
    commands = motion.commands
    horizon = registry.task(row.protocol.task).horizon
    env.restart(seed=row.protocol.start(test))
    start = [int(value) for value in env.episode.macrostate]
    actions: list[int] = []
    states: list[list[int]] = []
    success = False
    for command in np.concatenate([commands, np.repeat(commands[-1:], motions.SLACK_PERIODS, axis=0)]):
        (period,) = env.carry_out(command[np.newaxis])
        event = env.episode.latest
        success |= period.success
        if event is not None and event.fault is None:
            actions.append(int(event.action))
            states.append([int(value) for value in event.outcome.macrostate])
        if period.terminated or period.truncated or len(actions) == horizon:
            break
    return {
        "start": start,
        "actions": actions,
        "states": states,
        "success": success and motion.reproducible,
        "reproducible": motion.reproducible,
    }


def moved(folder: Path) -> dict[str, object] | None:
    """A row of continuous control for the page; None of a task that it has no scene of.

    Raises:
        ArtefactError: The row is damaged, or does not play again.
    """
    row = motion_rows.read_motions(folder)
    spec: TaskSpec = registry.task(row.protocol.task)
    if not has_scene(spec):
        return None
    with closing(row.protocol.make(observation="state")) as env:
        checked = motions.check_motions(row, env)
        unwrapped = env.unwrapped
        assert isinstance(unwrapped, MotionEnv)
        episodes = [_events(unwrapped, checked, test) for test in range(row.protocol.tests)]
    solved = f"{checked.vouched.successes} of {row.protocol.tests} solved"
    title = f"{row.claimed.agent}, continuous control in {spec.id}, each event as a planned movement: {solved}"
    return {"title": title, "world": spec.id, "episodes": episodes}


def write(folder: Path, board: Path = BOARD) -> None:
    """Write every row of a board into a folder, and ``index.json``: names and titles."""
    folder.mkdir(parents=True, exist_ok=True)
    index = []
    for path in sorted(board.glob("*/card.json")):
        card = json.loads(path.read_text())
        if card.get("format") == motion_rows.FORMAT:
            row = moved(path.parent)
        else:
            row = converted(card, json.loads(path.with_name("episodes.json").read_text()))
        if row is not None:
            index.append([path.parent.name, row["title"]])
            (folder / f"{path.parent.name}.json").write_text(json.dumps(row, separators=(",", ":")))
    (folder / "index.json").write_text(json.dumps(index))
