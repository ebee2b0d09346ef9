"""Conformal acceptance of imagined transitions: a threshold with a guarantee, and whether the guarantee holds.

A transition is accepted if its uncertainty is below a threshold t. Of n transitions from some distribution it is known
whether they are imagined wrongly. Let k = floor(ALPHA (n + 1)) - 1, and let t be the uncertainty of the wrong one that
has k wrong ones before it; if there are no more than k, everything is accepted. If another transition comes from the
same distribution, the probability that it is accepted though it is wrong is at most ALPHA.

Proof. It is accepted though wrong only if at most k of the n others are wrong and not more uncertain. Of n + 1
transitions at most k + 1 have that property: of any k + 2 wrong ones the most uncertain lacks it. All n + 1 are equally
likely to be the last one, so its probability is at most (k + 1) / (n + 1) <= ALPHA. This is conformal risk control
(Angelopoulos et al., arXiv 2208.02814) with the loss 1 for accepted and wrong, else 0.

The guarantee is a mean over the n transitions, too. It says nothing about other distributions.

Shapes: ``N`` questions about single macro-actions, ``P`` policies, ``S`` macrostates, ``A`` macro-actions.
"""

from __future__ import annotations

import math

import numpy as np

from imagine_bench.arrays import Bools, Floats
from imagine_bench.judge.policies.exploit import visited
from imagine_bench.judge.policies.policy_set import PolicyWorld

ALPHA = 0.05
SCORES = ("accepts", "wrong_on_data", "wrong_rare", "wrong_policies", "wrong_worst_policy")
_CALIBRATED = 100  # n
_DRAWS = 400  # sets of n transitions
_RARE = 0.25  # share of the macrostates, those that the data's policy reaches least
_ROUNDING = 1e-9


def conformal_threshold(uncertainty: Floats, wrong: Bools, alpha: float = ALPHA) -> float:
    """The threshold t of n transitions, two of shape (n,); ``uncertainty < t`` is accepted."""
    before = math.floor(alpha * (len(wrong) + 1) + _ROUNDING) - 1
    if before < 0:
        return -math.inf
    of_wrong = np.sort(uncertainty[wrong])
    return float(of_wrong[before]) if len(of_wrong) > before else math.inf


def occupancies(world: PolicyWorld, tables: Floats) -> Floats:
    """The share of each macrostate and macro-action among the transitions of policies (P, S, A). Shape (P, S, A)."""
    plans = np.repeat(tables[:, None], world.horizon, axis=1)
    reached = np.sum(visited(world.dense_truth, plans, world.starts), axis=0)
    pairs = reached[..., None] * tables
    return np.asarray(pairs / pairs.sum(axis=(1, 2), keepdims=True))


def acceptance_scores(
    world: PolicyWorld, data: Floats, uncertainty: Floats, wrong: Bools, rng: np.random.Generator
) -> dict[str, float]:
    """The share of transitions that are accepted, and shares that are accepted though wrong.

    Thresholds are chosen on transitions that are drawn independently from the data's distribution, and the shares are
    means over such draws; else all is enumerated. Besides the data's distribution: every macro-action in the
    macrostates that are rarest there, and the transitions of the world's policies, in the mean and of the worst one.

    Args:
        world: The world and its policies.
        data: Shares of macrostates and macro-actions in the data. Shape (S, A).
        uncertainty: Of each question, in the order of macrostates, macro-actions and frames. Shape (N,).
        wrong: Whether it is imagined wrongly. Shape (N,).
        rng: Draws the transitions.
    """
    rarest = np.argsort(data.sum(axis=1), kind="stable")[: math.ceil(_RARE * len(data))]
    rare = np.zeros_like(data)
    rare[rarest] = 1.0 / rare[rarest].size
    distributions = np.concatenate([[data, rare], occupancies(world, world.policies.tables)])
    frames = len(wrong) // data.size
    shares = np.repeat(distributions.reshape(len(distributions), -1), frames, axis=1) / frames  # [2 + P, N]
    drawn = rng.choice(len(wrong), size=(_DRAWS, _CALIBRATED), p=shares[0])
    accepted = np.mean([uncertainty < conformal_threshold(uncertainty[rows], wrong[rows]) for rows in drawn], axis=0)
    on_data, on_rare, *on_policies = (shares @ (accepted * wrong)).tolist()
    found = (float(shares[0] @ accepted), on_data, on_rare, float(np.mean(on_policies)), max(on_policies))
    return dict(zip(SCORES, found, strict=True))
