"""Kinds of forged rows, each a function that changes a copy of an honest board as its generator draws.

A kind with an empty claim must be refused each time. Any other may also be held, if the row's verdict says that the
forged claim is not vouched, or if the row stands in a table of another world.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping

import numpy as np
from board_forging import ROUND, BoardForger, Forgery, OpenRow
from forging import WORLD
from imagine_bench_board.rounds import promise

from imagine_bench import registry
from imagine_bench.running.evaluation import EvaluationCounts, RecordedEnv, replay
from imagine_bench.running.run_state import make_env
from imagine_bench.seeding import episode_seed

PLAYER = "the player"
SEEDS = "which seeds and how many tests"
PRICE = "the price"
BEFOREHAND = "the data seen beforehand"


def edited_card(f: BoardForger) -> OpenRow:
    """A figure of the card alone."""
    row = f.any_learner()
    figures = f.pick(*row.card["vouched"])
    name = f.pick("successes", "mean_return", "mean_length", "faults")
    figures[name] += f.pick(1, 2)
    return row.write()


def edited_everywhere(f: BoardForger) -> OpenRow:
    """Failed tests called solved, in the flags, the returns and every figure."""
    row = f.any_learner()
    part = f.pick(*row.parts)
    failed = [test for test, each in enumerate(part["solved"]) if each == "0"]
    for test in failed[: f.pick(1, 3, len(failed))]:
        part["solved"] = part["solved"][:test] + "1" + part["solved"][test + 1 :]
        part["returns"][test] = f.pick(50.0, 49.0)
    if not failed:
        part["returns"][0] += 1.0
    return row.sealed()


def unsealed(f: BoardForger) -> OpenRow:
    """Episodes changed after they were sealed."""
    row = f.any_learner()
    part = f.pick(*row.parts)
    part["returns"][f.pick(0, 1, 2)] += 1.0
    row.follow()
    return row.write(sealed=False)


def better_actions(f: BoardForger) -> OpenRow:
    """Macro-actions changed, the outcomes left as they were."""
    row = f.learner()
    part = f.pick(*row.parts)
    test = f.pick(*range(len(part["actions"])))
    actions = part["actions"][test]
    actions[-1] = (actions[-1] + f.pick(1, 2, 3)) % 6
    return row.sealed()


def fingerprints(f: BoardForger) -> OpenRow:
    """A fingerprint or a start changed."""
    row = f.any_learner()
    part = f.pick(*row.parts)
    test = f.pick(0, 1, 2)
    if f.pick(True, False):
        part["fingerprints"][test] ^= f.pick(1, 256)
    else:
        part["starts"][test][0] = (part["starts"][test][0] + 1) % 4
    return row.write()


def swapped_agents(f: BoardForger) -> OpenRow:
    """Two learners' rows under each other's names."""
    row = f.any_learner()
    other = f.other(row)
    row.parts, other.parts = other.parts, row.parts
    row.card["vouched"], other.card["vouched"] = other.card["vouched"], row.card["vouched"]
    other.write()
    return row.write()


def another_seeds_episodes(f: BoardForger) -> OpenRow:
    """The tests of the best seed in place of another's."""
    row = f.learner()
    returns = [figures["mean_return"] for figures in row.card["vouched"]]
    row.parts[int(np.argmin(returns))] = row.parts[int(np.argmax(returns))]
    return row.sealed()


def copied_row(f: BoardForger) -> OpenRow:
    """Somebody's row under another name, with another player."""
    row = f.learner()
    row.folder = row.folder.with_name(f.pick("zz-mine", "zz_better-1"))
    row.folder.mkdir()
    row.card["claimed"] |= {"agent": "imagination", "author": "somebody else"}
    row.protocol["agents"] = ["imagination"]
    return row.write()


def dropped_failures(f: BoardForger) -> OpenRow:
    """Failed tests left out: some in the middle, which moves the others, or the last ones."""
    row = f.learner()
    tests = row.protocol["evaluation_episodes"]
    how_many = f.pick(1, 2)
    failed = [test for test in range(tests) if all(part["solved"][test] == "0" for part in row.parts)]
    left_out = f.pick(failed[:how_many], [*range(tests - how_many, tests)])
    for place in range(len(row.parts)):
        row.drop_tests(place, left_out)
    row.protocol["evaluation_episodes"] = tests - len(left_out)
    return row.sealed()


def dropped_seed(f: BoardForger) -> OpenRow:
    """The worst seed left out in every copy."""
    row = f.any_learner()
    seeds = row.protocol["seeds"]
    worst = min(row.card["vouched"], key=lambda figures: figures["mean_return"])["seed"]
    kept = [place for place, figures in enumerate(row.card["vouched"]) if figures["seed"] != worst]
    row.protocol["seeds"] = [seed for seed in seeds if seed != worst]
    row.keep_places(kept)
    return row.write()


def renamed_seeds(f: BoardForger) -> OpenRow:
    """Cherry-picked seeds under the usual numbers."""
    row = f.learner()
    names = dict(zip(row.protocol["seeds"], f.pick([0, 1, 2], [5, 6, 7], [0, 1, 900]), strict=True))
    for figures in row.card["vouched"]:
        figures["seed"] = names[figures["seed"]]
    row.protocol["seeds"] = [*names.values()]
    return row.write()


def by_oracle(f: BoardForger) -> OpenRow:
    """Open tests that an oracle, or somebody nearly as good, played."""
    row = f.learner()
    for place in range(len(row.parts)):
        row.set_tests(place, f.played(row.protocol["evaluation_episodes"]))
    return row.sealed()


def longer(f: BoardForger) -> OpenRow:
    """Episodes that go on after their end, or a longer horizon in the world's line."""
    row = f.learner()
    if f.pick(True, False):
        part = f.pick(*row.parts)
        part["actions"][f.pick(0, 1)] += [f.pick(0, 1)] * f.pick(1, 5)
    else:
        row.protocol["task"] = f"arrows:horizon={f.pick(20, 50)}"
    return row.sealed()


def easier_starts(f: BoardForger) -> OpenRow:
    """Tests from starts near the goal, with macro-actions that fit."""
    row = f.learner()
    env = RecordedEnv(make_env(WORLD, "arrow_puzzle"))
    rules = registry.task("arrow_puzzle").rules
    log = EvaluationCounts()
    seed = f.pick(0, 1000)
    while log.episodes < row.protocol["evaluation_episodes"]:
        _, info = env.reset(seed=episode_seed("evaluation", 0, seed))
        action = rules.optimal_action(tuple(info["macrostate"].tolist()))
        seed += 1
        if env.step(action)[2]:  # solved by one macro-action
            log.add(env.episode)
    for place in range(len(row.parts)):
        row.set_tests(place, log)
    return row.sealed()


def other_world(f: BoardForger) -> OpenRow:
    """Tests of an easier world, or said to be of a harder one."""
    row = f.learner()
    row.protocol["task"] = f.pick("arrow_puzzle_hard", "arrow_puzzle_toward", "arrow_puzzle_clockwise")
    if f.pick(True, False):
        row.protocol["task"] = "arrow_puzzle"
        other = WORLD.__class__(task="arrow_puzzle_toward", preset="smoke", execution="kinematic")
        env = make_env(other, other.task)
        log = EvaluationCounts()
        for test in range(row.protocol["evaluation_episodes"]):
            log.add(replay(env, episode_seed("evaluation", 0, test), [0, 0, 2, 2, 4, 4, 1, 1, 3, 3])[0])
        row.set_tests(0, log)
        row.follow()
    return row.write()


def called_physics(f: BoardForger) -> OpenRow:
    """Kinematic episodes, said to be played in physics."""
    row = f.learner()
    row.protocol["execution"] = "physics"
    if f.pick(True, False):
        for part in row.parts:
            part["sim_times_s"] = [float(f.rng.uniform(4, 12)) * len(each) for each in part["actions"]]
    return row.write()


def prices(f: BoardForger) -> OpenRow:
    """Costs that are invented."""
    row = f.learner()
    for price in row.card["claimed"]["prices"]:
        if f.pick(True, False):
            price["train_cpu_s"] *= float(f.pick(0.01, 0.5))
        else:
            price["env_steps"] = int(price["env_steps"] * f.pick(0.1, 0.8))
    return row.write()


def later_called_earlier(f: BoardForger) -> OpenRow:
    """Tests after more episodes, said to be after fewer."""
    row = f.learner()
    most = row.protocol["budgets"][-1]
    places = [place for place, figures in enumerate(row.card["vouched"]) if figures["episodes"] == most]
    row.keep_places(places)
    row.protocol["budgets"] = [f.pick(3, 5)]
    for figures, price in zip(row.card["vouched"], row.card["claimed"]["prices"], strict=True):
        figures["episodes"] = row.protocol["budgets"][0]
        price["env_steps"] = figures["episodes"] * 2
    return row.write()


def unseen(f: BoardForger) -> OpenRow:
    """Encoders, datasets and demonstrations concealed."""
    row = f.any_learner()
    row.card["claimed"] |= {"seen_beforehand": "nothing", "frames_beforehand": f.pick(0, 10)}
    return row.write()


def file_as(f: BoardForger, row: OpenRow, agents: dict[str, str]) -> None:
    """File digests under a row's name, as if before the round began."""
    (f.board / "rounds" / ROUND / "filed" / f"{row.folder.name}.json").write_text(json.dumps(agents))


def called_dated(f: BoardForger) -> OpenRow:
    """A row with open starts that says it is of the round; now and then its agents are filed after all."""
    row = f.learner()
    row.card["round"] = ROUND
    if f.pick(True, False):
        row.folder = row.folder.rename(row.folder.with_name(f"zz-{ROUND}"))
        file_as(f, row, {str(figures["seed"]): "" for figures in row.card["vouched"]})
    return row.write()


def other_agents(f: BoardForger) -> OpenRow:
    """A row of the round by agents that were not filed; their digests are exchanged, now and then in the file, too."""
    row = f.learner(dated=True)
    row.card["claimed"]["prices"][0]["agent_sha256"] = f.pick("0" * 64, "")
    if f.pick(True, False):
        both = zip(row.card["vouched"], row.card["claimed"]["prices"], strict=True)
        file_as(f, row, {str(figures["seed"]): price["agent_sha256"] for figures, price in both})
    return row.write()


def other_seed(f: BoardForger) -> OpenRow:
    """The round's seed exchanged for another, with or without a new promise; the episodes are those of the first."""
    row = f.learner(dated=True)
    folder = f.board / "rounds" / ROUND
    revealed = json.loads((folder / "revealed.json").read_text())
    revealed["seed"] = (revealed["seed"] + f.pick(1, 17)) % 2**24
    (folder / "revealed.json").write_text(json.dumps(revealed))
    if f.pick(True, False):
        promised = json.loads((folder / "round.json").read_text())
        promised["sha256"] = promise(revealed["seed"], revealed["salt"])
        (folder / "round.json").write_text(json.dumps(promised))
    return row


def round_left_out(f: BoardForger) -> OpenRow:
    """The tests of a round, said to be of open starts, or the round is removed."""
    row = f.learner(dated=True)
    if f.pick(True, False):
        row.card["round"] = ""
    else:
        shutil.rmtree(f.board / "rounds" / ROUND)
    return row.write()


KINDS: Mapping[str, tuple[Forgery, str]] = {
    "a figure edited": (edited_card, ""),
    "every copy edited": (edited_everywhere, ""),
    "episodes edited after sealing": (unsealed, ""),
    "macro-actions edited": (better_actions, ""),
    "a fingerprint or start edited": (fingerprints, ""),
    "agents swapped": (swapped_agents, PLAYER),
    "another seed's episodes": (another_seeds_episodes, SEEDS),
    "a row copied": (copied_row, PLAYER),
    "failures dropped": (dropped_failures, SEEDS),
    "a failed seed dropped": (dropped_seed, SEEDS),
    "seeds cherry-picked": (renamed_seeds, SEEDS),
    "played by the oracle": (by_oracle, PLAYER),
    "a longer horizon": (longer, ""),
    "easier starts": (easier_starts, ""),
    "another world": (other_world, ""),
    "kinematic called physics": (called_physics, ""),
    "prices forged": (prices, PRICE),
    "later tests called earlier": (later_called_earlier, PRICE),
    "beforehand concealed": (unseen, BEFOREHAND),
    "open starts called dated": (called_dated, ""),
    "agents not filed": (other_agents, ""),
    "the round's seed exchanged": (other_seed, ""),
    "a round left out": (round_left_out, ""),
}
