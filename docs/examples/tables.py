"""How far the actions' effects that `factored:given` learned are from the rules, after the cautious learner's
transitions.

python tables.py slip=0.1 slip=0.2 fickle=0.2 --out tables.json
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from imagine_bench_factored.agent import FactoredAgent, make

from imagine_bench import registry
from imagine_bench.exact.certificate import certificate
from imagine_bench.interfaces import AgentContext, Frame, Observation, State, TaskSpec, Transition
from imagine_bench.judge.truth import total_variation
from imagine_bench.registry.machine import describe_environment
from imagine_bench.rules import states_of
from imagine_bench.seeding import SeedTree
from imagine_bench.store import encoders

MULTIPLES = (0.5, 1.0, 2.0, 4.0)


def away(agent: FactoredAgent, spec: TaskSpec, frames: Frame) -> float:
    """Mean total variation of where actions lead that surely end nothing, asked with ``frames`` (S, 64, 64, 3)."""
    codes = np.array(agent.perception.codes(frames))
    moves = agent.model.moves(codes)
    following = moves.following.reshape(-1, codes.shape[1]).tolist()
    read = agent.perception.macrostates([tuple(code) for code in following]).reshape(*moves.chance.shape, -1)
    found = []
    for row, state in enumerate(states_of(spec.rules)):
        for action in range(0 if spec.rules.is_terminal(state) else spec.rules.n_actions):
            outcomes = spec.rules.outcomes(state, action)
            if any(outcome.terminated for outcome in outcomes):
                continue
            exact: Counter[State] = Counter()
            held: Counter[State] = Counter()
            for outcome in outcomes:
                exact[outcome.macrostate] += outcome.probability
            for after, chance in zip(read[row, action].tolist(), moves.chance[row, action].tolist(), strict=True):
                held[tuple(after)] += chance
            found.append(total_variation(exact, held))
    return float(np.mean(found))


def learn(parameters: dict[str, float], spec: TaskSpec, seed: int, budgets: Sequence[int]) -> list[float]:
    """Train in frames of the world, without physics; how far it is away after each number of transitions."""
    seeds = SeedTree(seed)
    agent = make(
        AgentContext(
            n_actions=spec.rules.n_actions, preprocessing=spec.preprocessing, seeds=seeds.child("agent"),
            encoder=encoders.own(spec, "clean", kind="codes"),
        )
    )  # fmt: skip
    every = np.array(states_of(spec.rules))
    frames = spec.render_macrostates(every, "clean", seeds.child("asked").generator())
    found = []
    with closing(gymnasium.make("imagine_bench/Arrows-v0", execution="kinematic", **parameters)) as env:
        frame, _ = env.reset(seed=seed)
        for count in range(1, max(budgets) + 1):
            seen = Observation(frame=frame)
            action = agent.act(seen, explore=True)
            frame, reward, terminated, truncated, _ = env.step(action)
            agent.observe(
                Transition(
                    observation=seen, action=action, reward=float(reward), next_observation=Observation(frame=frame),
                    terminated=terminated, truncated=truncated,
                ),
                episode=0,
            )  # fmt: skip
            if terminated or truncated:
                frame, _ = env.reset()
            if count in budgets:
                agent.learn()
                found.append(away(agent, spec, frames))
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parameters", nargs="+", help="of arrows:, such as slip=0.1")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(arguments)
    result: dict[str, Any] = {**describe_environment(), "worlds": {}}
    for given in options.parameters:
        spec = registry.task(f"arrows:{given}")
        parameters = {name: float(value) for name, value in (each.split("=") for each in given.split(","))}
        known = certificate(spec).learning_cost
        assert known is not None
        budgets = [round(share * known.transitions) for share in MULTIPLES]
        found = [learn(parameters, spec, seed, budgets) for seed in options.seeds]
        result["worlds"][given] = {"transitions": budgets, "total_variation": found}
        print(given, *(f"{n}: {mean:.3f}" for n, mean in zip(budgets, np.mean(found, axis=0), strict=True)), flush=True)
    if options.out:
        options.out.write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
