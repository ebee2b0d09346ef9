"""Levels 5 to 7 of a model: it ranks policies, training in it pays, and no policy exploits it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from imagine_bench.arrays import Floats, Ints
from imagine_bench.exact.values import NEVER, Model, rows_of, values_of_planning
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.judge.policies.agreement import dense, kendall, pearson, values_of
from imagine_bench.judge.policies.exploit import Exploit, largest_exploit, upper_bound
from imagine_bench.judge.policies.policy_set import PolicyWorld
from imagine_bench.judge.policies.training import trained

SCORES = ("policy_r", "policy_tau", "policy_error", "lift", "lift_trained", "exploit", "exploit_bound")


class WithoutModel(NamedTuple):
    """Returns, in the truth, of learning from a model's data without the model."""

    planned: Floats  #: of the plan that is optimal in the counts of the data, from each macrostate; shape (S,)
    trained: float  #: of agents that train on the data, from a start; the mean


def without_model(world: PolicyWorld, table: Model, rng: np.random.Generator) -> WithoutModel:
    """The returns of learning from the data of which ``table`` are the counts."""
    planned = values_of_planning(world.truth, table, world.horizon)
    return WithoutModel(planned, _mean_return(world, trained(table, rng)))


def level_scores(
    world: PolicyWorld, held: Model, without: WithoutModel | None, rng: np.random.Generator
) -> tuple[dict[str, float], Exploit]:
    """The scores of a model, and the policy that it overrates most. Returns are expected, from a start, undiscounted.

    ``policy_r`` and ``policy_tau`` compare the returns of the world's policies in model and truth, and ``policy_error``
    is their mean absolute difference. ``lift`` is the return, in the truth, of the plan that is optimal in the model,
    less that of the plan that is optimal in the counts of the model's data; NaN where ``without`` is None.
    ``lift_trained`` is the same of agents that train there, the mean of :data:`.training.AGENTS`. ``exploit`` and
    ``exploit_bound`` enclose the largest difference that any policy has between model and truth.
    """
    model = dense(held)
    imagined = values_of(model, world.policies.tables, world.horizon) @ world.starts
    found = largest_exploit(model, world.dense_truth, world.starts, world.policies.tables, world.horizon, rng)
    lift = lift_trained = math.nan
    if without is not None:
        (draws,) = rng.spawn(1)
        agents = trained(held, draws, (world.starts, world.horizon))
        lift_trained = _mean_return(world, agents) - without.trained
        lift = float((values_of_planning(world.truth, held, world.horizon) - without.planned) @ world.starts)
    scores = (
        pearson(imagined, world.real),
        kendall(imagined, world.real),
        float(np.abs(imagined - world.real).mean()),
        lift,
        lift_trained,
        float((found.believed - found.real) @ world.starts),
        float(upper_bound(model, world.dense_truth, world.horizon) @ world.starts),
    )
    return dict(zip(SCORES, scores, strict=True)), found


def _mean_return(world: PolicyWorld, policies: Floats) -> float:
    """The mean return of policies in the truth, from a start."""
    return float((values_of(world.dense_truth, policies, world.horizon) @ world.starts).mean())


def counted_table(episodes: Episodes, macrostates: Ints, transitions: int, world: PolicyWorld) -> Model:
    """The model that counts the first transitions of a dataset: shares of outcomes, and mean rewards.

    A macro-action that was never tried has the reward :data:`.NEVER`, so that a plan tries it only where it must.
    ``macrostates`` (F, M) are those of the dataset's frames.
    """
    n_states, n_actions = world.truth.reward.shape
    first = episodes.rows[0][:transitions]
    before, after = (rows_of(macrostates[each], world.states) for each in (first, first + 1))
    actions = episodes.actions[:transitions]
    onward = np.zeros((n_states + 1, n_actions, n_states + 1))
    np.add.at(onward, (before, actions, after), ~episodes.terminated[:transitions])
    paid, tried = np.zeros((2, n_states + 1, n_actions))
    np.add.at(paid, (before, actions), episodes.rewards[:transitions])
    np.add.at(tried, (before, actions), 1.0)
    often = np.maximum(tried, 1.0)[:-1]
    following = np.broadcast_to(np.arange(n_states + 1), (n_states, n_actions, n_states + 1))
    return Model(following, onward[:-1] / often[..., None], np.where(tried[:-1] > 0, paid[:-1] / often, NEVER))
