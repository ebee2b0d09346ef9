"""Thirteen kinds of forged results, each a function that changes a copy of an honest bench as its generator draws."""

from __future__ import annotations

import copy
import functools
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from forging import (
    BUDGETS,
    LEARNERS,
    TESTS,
    Forger,
    Hand,
    OpenRun,
    Remembering,
    Repeats,
    all_runs,
    honest_bench,
    mixed,
    tests_by,
    training_by,
)

from imagine_bench.running.bench import plan


class Donors:
    """Benches that a forger runs apart, to take results from."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._launcher = Remembering(root / "done")
        self._made: dict[str, Path] = {}

    def run(self, agent: str, seed: int, **changes: Any) -> OpenRun:
        key = repr((agent, seed, sorted(changes.items())))
        if key not in self._made:
            self._made[key] = honest_bench(self._root, self._launcher, agents=(agent,), seeds=(seed,), **changes)
        return OpenRun.read(self._made[key] / agent / f"seed_{seed}")


def take_row(run: OpenRun, row: int, donor: OpenRun, donor_row: int, *, with_figures: bool) -> None:
    """Let a budget's tests be those of another run or budget; the price and the episodes stay the run's own."""
    run.set_tests(row, donor.tests(donor_row))
    prefix = f"rows/{donor_row}/beliefs/"
    taken = {name: array for name, array in donor.arrays.items() if name.startswith(prefix)}
    if taken and with_figures:
        run.drop(f"rows/{row}/beliefs/")
        run.arrays |= {name.replace(prefix, f"rows/{row}/beliefs/"): array for name, array in taken.items()}
        run.rows[row]["beliefs"] = donor.rows[donor_row]["beliefs"]
    if with_figures:
        told = donor.rows[donor_row]["diagnostics"]
        mine = run.rows[row]["diagnostics"]
        run.rows[row]["diagnostics"] = {name: told.get(name, value) for name, value in mine.items()}
        run.say_steps(run.rows[row])


def edited_table(f: Forger, donors: Donors) -> None:
    """A table edited by hand: successes, a return or a length, in the checkpoint too, now and then in its flags."""
    what = f.pick("successes", "mean_return", "mean_length", "faults", "flags", "no episodes")
    rows = f.rows()

    def change(run: OpenRun) -> None:
        for at in rows:
            row = run.rows[at]
            if what in ("successes", "flags", "no episodes"):
                more = int(f.rng.integers(1, TESTS))
                solved = [*row["solved"]]
                for test in f.rng.permutation([i for i, each in enumerate(solved) if each == "0"])[:more]:
                    solved[int(test)] = "1"
                row |= {"solved": "".join(solved), "successes": solved.count("1")}
                row["mean_return"] += 5.5 * more
            elif what == "faults":
                row["faults"] += int(f.rng.integers(1, 4))
            else:
                row[what] = round(row[what] + float(f.rng.normal(0, 1)), 3)
            if what == "flags":
                success = np.array([each == "1" for each in row["solved"]])
                returns = run.arrays[f"rows/{at}/kept/returns"]
                run.arrays[f"rows/{at}/kept/returns"] = np.where(success, 50.0, returns)
                run.arrays[f"rows/{at}/kept/success"] = success
                row["mean_return"] = float(run.arrays[f"rows/{at}/kept/returns"].mean())
            if what == "no episodes":
                run.drop(f"rows/{at}/kept/")
                row["kept"] = None

    f.edit(change)


def new_names(f: Forger) -> dict[int, int]:
    """Seeds and the false names that they get: new ones, or one another's."""
    if f.every and f.pick("new", "turned") == "turned":
        return dict(zip(f.seeds, np.roll(f.seeds, f.pick(1, 2)).tolist(), strict=True))
    drawn = f.rng.choice(np.arange(3, 900), len(f.seeds), replace=False)
    return dict(zip(f.seeds, drawn.tolist(), strict=True))


def said(f: Forger) -> None:
    """The sessions' command agrees with the protocol, now and then."""
    if f.pick("command said", "command as it was") == "command said":
        seeds = " ".join(map(str, f.protocol["seeds"]))
        command = f"imagine-bench bench arrow_puzzle --preset smoke --seeds {seeds}"

        def change(found: dict[str, Any]) -> None:
            found["environment"]["command"] = command
            found["sessions"][-1] |= {"command": command, "wall_s": float(f.rng.uniform(10, 60))}

        f.sessions(change)


def renamed(f: Forger, donors: Donors) -> None:
    """A seed called another."""
    if f.pick("as it is", "weights touched") == "weights touched":
        f.edit(lambda run: touch(f, run))
    f.rename_seeds(new_names(f))
    said(f)


def touch(f: Forger, run: OpenRun) -> None:
    """Weights changed where nobody sees it."""
    run.agent = copy.copy(run.agent)
    floats = {name: array for name, array in run.agent.arrays.items() if array.dtype.kind == "f"}
    size = float(f.pick(1e-7, 1e-3))
    noisy = {
        name: (array + size * f.rng.normal(size=array.shape)).astype(array.dtype) for name, array in floats.items()
    }
    object.__setattr__(run.agent, "arrays", {**run.agent.arrays, **noisy})


def renamed_with_starts(f: Forger, donors: Donors) -> None:
    """A seed called another, and its training played from the other's starts."""
    names = new_names(f)
    how = f.pick("its macro-actions", "a random hand", "a skilled hand")
    is_touched = f.chance(0.5)
    learners = [f.run(agent, seed) for agent in LEARNERS for seed in names]
    for run in learners:
        seed = names[run.seed]
        if how == "its macro-actions":
            hand: Any = Repeats([action for each in run.training_actions() for action in each], f.rng)
        else:
            hand = Hand(0.0 if how == "a random hand" else float(f.rng.uniform(0.3, 1.0)), f.rng)
        run.set_training(training_by(hand, seed, run.episode))
        if is_touched:
            touch(f, run)
        run.write()
    f.rename_seeds(names)
    said(f)


def renamed_without_starts(f: Forger, donors: Donors) -> None:
    """A seed called another, and the arrays that would show it deleted."""
    names = new_names(f)
    how = f.pick(
        "training", "older", "older and its starts", "older and no tests", "starts of tests", "training starts"
    )
    for run in [f.run(agent, seed) for agent in LEARNERS for seed in names]:
        if how == "training":
            run.drop("training/")
        elif how == "training starts":
            run.drop("training/starts")
        elif how == "starts of tests":
            run.drop(*(f"rows/{row}/kept/starts" for row in range(len(BUDGETS))))
        else:
            run.call_older()
            if how != "older":
                del run.values["starts"]
            if how == "older and no tests":
                for row in range(len(BUDGETS)):
                    run.drop(f"rows/{row}/kept/")
                    run.rows[row]["kept"] = None
        run.write()
    f.rename_seeds(names)
    said(f)


def by_oracle(f: Forger, donors: Donors) -> None:
    """Tests that the oracle played, handed in as a learner's."""
    rows = f.rows()
    skill = f.pick(1.0, 0.95, 0.8, 0.6)
    trained = f.pick("training as it was", "training by the hand too", "training by a worse hand")
    fixed = f.chance(0.3)

    def change(run: OpenRun) -> None:
        for row in rows:
            oracle = f.run("oracle", f.pick(*f.protocol["seeds"])) if fixed else None
            run.set_tests(row, tests_by(Hand(skill, f.rng)) if oracle is None else oracle.tests(row))
        if trained != "training as it was":
            hand = Hand(skill if trained == "training by the hand too" else skill / 2, f.rng)
            run.set_training(training_by(hand, run.seed, run.episode))
        if f.chance(0.5):
            touch(f, run)

    f.edit(change)


def swapped(f: Forger, donors: Donors) -> None:
    """A learner's results under another's name; the other is one of the bench, or one that was run apart."""
    whose = f.pick("each other's", "q_learning's", "random's")
    what = f.pick("tests", "tests and training", "everything", "one budget")
    both = {(agent, seed): f.run(agent, seed) for agent in LEARNERS for seed in f.seeds}

    def change(run: OpenRun) -> None:
        name = str(run.config["agent"])
        other = LEARNERS[1 - LEARNERS.index(name)]
        if whose == "each other's":
            donor = both[other, run.seed]
        elif whose == "q_learning's":
            donor = donors.run("q_learning", run.seed)
        else:
            donor = f.run("random", run.seed)
        for row in range(len(BUDGETS)) if what != "one budget" else [1]:
            take_row(run, row, donor, row, with_figures=f.chance(0.5))
        if what in ("everything", "tests and training") and whose != "random's":
            steps = {name: donor.values[name] for name in ("success", "length", "queries", "tried", "env_steps")}
            run.drop("training/")
            run.arrays |= {name: each for name, each in donor.arrays.items() if name.startswith("training/")}
            run.values |= steps
            for row, told in zip(run.rows, donor.rows, strict=True):
                row |= {name: told[name] for name in ("env_steps", "train_cpu_s", "eval_cpu_s")}
                run.say_steps(row)
        if what == "everything":
            run.agent = donor.agent

    f.edit(change)


def dropped_seed(f: Forger, donors: Donors) -> None:
    """Seeds that failed, left out in every copy."""
    seeds = list(f.protocol["seeds"])
    agent = f.pick(*LEARNERS)
    seeds.sort(key=lambda seed: f.run(agent, seed).rows[-1]["mean_return"])
    left = seeds[2:] if f.every and f.pick("two of three", "one of three") == "two of three" else seeds[1:]
    if f.chance(0.3):
        left = left[::-1]
    for seed in set(seeds) - set(left):
        for path in f.folder.glob(f"*/seed_{seed}"):
            shutil.rmtree(path)
    f.set_protocol(seeds=left)
    said(f)


def later_tests(f: Forger, donors: Donors) -> None:
    """Tests after more episodes, called tests after fewer."""
    how = f.pick("the bench's own", "of a longer run")
    with_figures = f.chance(0.5)
    with_weights = f.chance(0.5)
    longer = int(f.pick(60, 90, 120))

    def change(run: OpenRun) -> None:
        agent = str(run.config["agent"])
        if how == "the bench's own":
            take_row(run, 0, run, 1, with_figures=with_figures)
            return
        donor = donors.run(agent, run.seed, budgets=(*BUDGETS, longer))
        for row in f.pick([1], [0, 1]):
            take_row(run, row, donor, row + 1, with_figures=with_figures)
        if with_weights:
            run.agent = donor.agent

    f.edit(change)


@functools.cache
def identity(encoder: str) -> str:
    return str(plan("arrow_puzzle", "smoke", agents=("dqn",), encoder=encoder)[0].as_dict()["encoder"])


def run_with_others(f: Forger, donors: Donors) -> None:
    """Results of runs with another setting or encoder, in place of the bench's own."""
    explored = float(f.pick(0.1, 0.2, 0.3, 0.4, 0.6))
    eyes = f.pick("arrow_puzzle-mild", "arrow_puzzle-strong")
    kind = f.pick("settings", "encoder", "tests of settings") if f.agents != ["count_table"] else "settings"
    f.agents = [agent for agent in f.agents if agent == "dqn" or "settings" in kind]

    def change(run: OpenRun) -> None:
        agent = str(run.config["agent"])
        others: dict[str, Any] = {"overrides": (("controller.epsilon_max", explored),)}
        if kind == "encoder":
            others = {"encoder": eyes}
        donor = donors.run(agent, run.seed, **others)
        if kind == "tests of settings":
            for row in range(len(BUDGETS)):
                take_row(run, row, donor, row, with_figures=True)
            return
        mine = run.agent.values
        run.agent, run.arrays, run.values = donor.agent, donor.arrays, donor.values
        if agent == "dqn":
            run.agent.values["settings"] = mine["settings"]

    f.edit(change)


def other_settings(f: Forger, donors: Donors) -> None:
    """Runs of another encoder, or with other settings, than the protocol says."""
    how = f.pick("run with others", "run with others", "digest", "encoder", "encoder's digest", "overrides")
    if not f.every or how == "run with others":
        run_with_others(f, donors)
        return
    digits = "".join(f.rng.choice([*"0123456789abcdef"], 12))
    if how == "digest":
        f.set_protocol(settings_digest=digits)
    elif how == "encoder":
        f.set_protocol(encoder=identity(f.pick("arrow_puzzle-mild", "arrow_puzzle-strong", "arrow_puzzle-photo")))
    elif how == "encoder's digest":
        f.set_protocol(encoder=f"{f.pick('arrow_puzzle-clean', 'my-encoder')}@{digits}")
    else:
        discount = float(f.pick(0.5, 0.7, 0.8, 0.9, 0.99))
        wanted, _ = plan(
            "arrow_puzzle", "smoke", agents=tuple(f.protocol["agents"]), overrides=(("controller.discount", discount),)
        )
        for run in [f.run("dqn", seed) for seed in f.seeds]:
            run.config["settings"]["controller"]["discount"] = discount
            if f.chance(0.7):
                run.agent.values["settings"]["controller.discount"] = discount
            run.write()
        f.set_protocol(**{name: wanted.as_dict()[name] for name in ("overrides", "settings_digest")})
    said(f)


def called_physics(f: Forger, donors: Donors) -> None:
    """Kinematic episodes, said to be played in physics."""
    how = f.pick("no time", "one time", "drawn times", "older")
    faults = f.chance(0.3)
    for run in list(all_runs(f.folder)):
        for group in [name.rpartition("/")[0] for name in run.arrays if name.endswith("/sim_times_s")]:
            lengths = run.arrays[f"{group}/lengths"].astype(float)
            each = f.rng.uniform(4, 12, lengths.shape) if how == "drawn times" else np.full(lengths.shape, 8.13)
            if how != "no time":
                run.arrays[f"{group}/sim_times_s"] = lengths * each
            if faults and group.startswith("rows"):
                run.arrays[f"{group}/faults"][0] = 1
                run.rows[int(group.split("/")[1])]["faults"] = 1
        if how == "older":
            run.call_older()
        run.write()
    f.set_protocol(execution="physics")
    said(f)


def best_copied(f: Forger, donors: Donors) -> None:
    """The best seed's results in place of others'; where every run is forged, that seed is none of the bench."""
    what = f.pick("tests", "tests and training", "everything")
    changed = f.pick("as they are", "failed tests changed", "weights touched", "both")
    best = {}
    for agent in f.agents:
        of_bench = [f.run(agent, seed) for seed in f.protocol["seeds"]]
        best[agent] = max([donors.run(agent, seed) for seed in (3, 4, 5)] if f.every else of_bench, key=score)

    def change(run: OpenRun) -> None:
        source = best[str(run.config["agent"])]
        if what != "everything":
            for row in range(len(BUDGETS)):
                take_row(run, row, source, row, with_figures=f.chance(0.5))
        else:
            mine = [(row["train_cpu_s"], row["eval_cpu_s"]) for row in run.rows]
            run.agent, run.arrays, run.values = source.agent, dict(source.arrays), copy.deepcopy(source.values)
            for row, (train_cpu_s, eval_cpu_s) in zip(run.rows, mine, strict=True):
                row |= {"train_cpu_s": train_cpu_s, "eval_cpu_s": eval_cpu_s}
        if what != "tests":
            flat = [action for each in source.training_actions() for action in each]
            run.set_training(training_by(Repeats(flat, f.rng), run.seed, run.episode))
        if changed in ("failed tests changed", "both"):
            for row in range(len(BUDGETS)):
                fail_otherwise(f, run, row)
        if changed in ("weights touched", "both"):
            touch(f, run)

    f.edit(change)


def score(run: OpenRun) -> float:
    return float(run.rows[-1]["mean_return"])


def fail_otherwise(f: Forger, run: OpenRun, row: int) -> None:
    """Play failed tests anew by a random hand, and keep those that fail again."""
    old = run.tests(row)
    new = tests_by(Hand(0.0, f.rng))
    failed = [pair == ("0", "0") for pair in zip(old.solved, new.solved, strict=True)]
    run.set_tests(row, mixed([new if each else old for each in failed]))


def cheaper(row: dict[str, Any], how: str, factor: float) -> None:
    """A row that says it cost less."""
    if how in ("train_cpu_s", "eval_cpu_s"):
        row[how] *= factor
    if how == "env_steps":
        row["env_steps"] = max(row["episodes"], int(row["env_steps"] * factor))
    if how == "time/":
        told = row["diagnostics"]
        row["diagnostics"] = {name: value * (factor if "time/" in name else 1) for name, value in told.items()}


def prices(f: Forger, donors: Donors) -> None:
    """Costs that are invented: CPU seconds, steps, training episodes on earlier tasks."""
    how = f.pick("train_cpu_s", "train_cpu_s", "eval_cpu_s", "env_steps", "shorter training", "before", "time/")
    factor = float(np.exp(f.rng.uniform(np.log(0.02), np.log(0.9))))
    has_lengths = f.chance(0.5)

    def change(run: OpenRun) -> None:
        if how == "shorter training":
            run.set_training(training_by(Hand(0.9, f.rng), run.seed, run.episode))
        if how == "before":
            run.values["before"] = int(f.rng.integers(1, 500))
        for row in run.rows:
            cheaper(row, how, factor)
            run.say_steps(row)
        run.values |= {name: run.rows[-1][name] for name in ("train_cpu_s", "env_steps")}
        if how == "env_steps" and has_lengths:
            run.values["length"] = np.ones(run.episode, dtype=int).tolist()

    f.edit(change)


def training_forged(f: Forger, donors: Donors) -> None:
    """Success or lengths of training episodes that never were."""
    how = f.pick("success", "length", "success and arrays", "length and arrays", "played by a hand")
    share = float(f.rng.uniform(0.1, 1.0))
    skill = float(f.rng.uniform(0.3, 1.0))

    def change(run: OpenRun) -> None:
        if how == "played by a hand":
            run.set_training(training_by(Hand(skill, f.rng), run.seed, run.episode))
            return
        for episode in f.rng.permutation(run.episode)[: max(1, int(share * run.episode))].tolist():
            if "success" in how:
                run.values["success"][episode] = not run.values["success"][episode]
            else:
                run.values["length"][episode] += int(f.rng.integers(1, 4))
        if how == "success and arrays":
            success = np.array(run.values["success"])
            run.arrays["training/success"] = success
            run.arrays["training/returns"] = np.where(success, 50.0, run.arrays["training/returns"])
        if how == "length and arrays":
            length = np.array(run.values["length"])
            run.arrays["training/lengths"] = length
            run.arrays["training/actions"] = f.rng.integers(0, 6, int(length.sum())).astype(np.uint8)
            for row in run.rows:
                row["env_steps"] = int(length[: row["episodes"]].sum())
                run.say_steps(row)
            run.values["env_steps"] = int(length.sum())

    f.edit(change)


KINDS: dict[str, Callable[[Forger, Donors], None]] = {
    "a table edited": edited_table,
    "a seed renamed": renamed,
    "the oracle's tests": by_oracle,
    "agents swapped": swapped,
    "a seed renamed, its starts remade": renamed_with_starts,
    "a seed renamed, its starts deleted": renamed_without_starts,
    "a failed seed dropped": dropped_seed,
    "later tests called earlier ones": later_tests,
    "another encoder or settings": other_settings,
    "kinematic called physics": called_physics,
    "the best seed copied": best_copied,
    "prices invented": prices,
    "training forged": training_forged,
}
