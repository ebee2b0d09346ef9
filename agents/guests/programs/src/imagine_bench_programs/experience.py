"""Real macro-actions between symbols; and the folder of them from which a coding agent writes a program."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from importlib import resources
from pathlib import Path

import numpy as np

from imagine_bench.errors import InvalidValueError, require_integer
from imagine_bench.interfaces import State, TaskSpec
from imagine_bench.registry import task
from imagine_bench.store.files import require_writable

from .writing.delay import CodedRow

Choose = Callable[[State], int]
See = Callable[[State], State]
_FILE = "experience.json"


def itself(state: State) -> State:
    """The same symbols."""
    return state


def play(
    spec: TaskSpec, choose: Choose, rng: np.random.Generator, see: See = itself
) -> Iterator[tuple[CodedRow, bool]]:
    """Macro-actions of one episode after another, without end, and whether each is the last of its episode.

    A macro-action comes about as the task's rules say, which is the kinematic execution. ``see`` turns the content of a
    frame, a macrostate with -1 where a coordinate is hidden, into symbols; without it they are that content. Where the
    newest frame hides a symbol (-1), it is the value last seen in the episode, or -1.
    """
    rules = spec.rules
    lag = 0 if spec.sight is None else spec.sight.lag
    while True:
        state = rules.start_states[int(rng.integers(len(rules.start_states)))]
        taken = [see(_seen(spec, state, 0, rng))]
        now = taken[0]
        for step in range(1, spec.horizon + 1):
            action = choose(now)
            outcomes = rules.outcomes(state, action)
            outcome = outcomes[int(rng.choice(len(outcomes), p=[each.probability for each in outcomes]))]
            state = outcome.macrostate
            taken.append(see(_seen(spec, state, step, rng)))
            shown = taken[max(0, step - lag)]
            then = tuple(old if new < 0 else new for new, old in zip(shown, now, strict=True))
            last = outcome.terminated or step == spec.horizon
            yield CodedRow(now, action, then, outcome.reward, outcome.terminated, step - 1), last
            if last:
                break
            now = then


def _seen(spec: TaskSpec, state: State, step: int, rng: np.random.Generator) -> State:
    """The content of a frame, -1 for a hidden coordinate."""
    if spec.sight is None:
        return state
    seen = spec.sight.seen(state, step)
    return seen[int(rng.choice(len(seen), p=[share for share, _ in seen]))][1]


def write_experience(task_name: str, folder: Path, *, macro_actions: int, seed: int) -> None:
    """Write the folder of a coding agent: transitions of random macro-actions, tests made from them, and a page.

    Raises:
        InvalidValueError: There is something in the folder, no macro-action is to be taken, or the seed is below 0.
        SetupError: The folder cannot be written.
    """
    require_integer("seed", seed, 0)
    if macro_actions < 1 or (folder.is_dir() and any(folder.iterdir())):
        raise InvalidValueError(f"{folder} gets {macro_actions} macro-actions; give an empty folder, and at least 1.")
    spec = task(task_name)
    require_writable(folder)
    rng = np.random.default_rng(seed)
    rows = []
    for row, last in play(spec, lambda _: int(rng.integers(spec.n_actions)), rng):
        rows.append([list(row.now), row.action, list(row.then), row.reward, row.ended, last])
        if len(rows) == macro_actions:
            break
    known = {
        "factors": [len(values) for values in spec.macrostate_values],
        "actions": spec.n_actions,
        "macro_actions": macro_actions,
        "columns": ["symbols", "action", "symbols after", "reward", "ended", "last of its episode"],
        "transitions": rows,
    }
    (folder / _FILE).write_text(json.dumps(known))
    for name, template in (("test_program.py", "test_program.txt"), ("README.md", "README.md")):
        text = resources.files(__package__).joinpath("folder", template).read_text()
        (folder / name).write_text(text)


def macro_actions_of(folder: Path, spec: TaskSpec) -> int:
    """The macro-actions behind a folder of experience. Raises InvalidValueError: it is none, or of another task."""
    try:
        known = json.loads((folder / _FILE).read_text())
        count = int(known["macro_actions"])
        fits = [*known["factors"], known["actions"]] == [*map(len, spec.macrostate_values), spec.n_actions]
        if fits and spec.sight is None:
            fits = all(_can_happen(spec, *row[:5]) for row in known["transitions"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InvalidValueError(f"{folder} holds no experience ({error}); give a folder of 'experience'.") from error
    if not fits:
        raise InvalidValueError(f"{folder} holds experience that {spec.id} cannot give; give that of this task.")
    return count


def _can_happen(spec: TaskSpec, now: list[int], action: int, then: list[int], reward: float, ended: bool) -> bool:
    outcomes = spec.rules.outcomes(tuple(now), action)
    return (tuple(then), reward, ended) in [(each.macrostate, each.reward, each.terminated) for each in outcomes]
