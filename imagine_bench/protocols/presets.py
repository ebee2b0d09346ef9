"""The presets of a bench of agents that act: named values of its protocol's fields."""

from __future__ import annotations

from typing import Any

_THESIS_AGENTS = ("dqn", "imagination", "imagination_uncertainty")
ALL_AGENTS = ("random", "oracle", *_THESIS_AGENTS)
"""The agents of a bench whose preset names none."""
_THESIS_BUDGETS = (250, 500, 1000, 1500, 2000, 3000, 4000, 5000, 6000)

PRESETS: dict[str, dict[str, Any]] = {
    "smoke": {
        "hyperparameters": "minimal", "seeds": (0,), "budgets": (10, 20), "evaluation_episodes": 20,
        "open_loop_starts": 20, "recorded_episodes": 2,
    },
    "quick": {
        "agents": ("random", "dqn", "dqn_more_updates", *_THESIS_AGENTS[1:], "factored:given", "oracle"),
        "seeds": tuple(range(6)), "budgets": (250, 400), "evaluation_episodes": 100,
        "few_seeds": {
            "dqn_more_updates": 10, "imagination": 7, "dqn": 6,
            "imagination_uncertainty": 1, "factored:given": 1, "random": 1, "oracle": 1,
        },
        "open_loop_starts": 20, "recorded_seeds": 1,
        "headlines": (("imagination", "dqn"), ("imagination", "dqn_more_updates")),
    },
    "thesis": {
        "hyperparameters": "published", "agents": _THESIS_AGENTS, "seeds": tuple(range(5)),
        "budgets": _THESIS_BUDGETS, "evaluation_episodes": 1000,
    },
    "full": {
        "hyperparameters": "published", "agents": ALL_AGENTS, "seeds": tuple(range(20)),
        "budgets": _THESIS_BUDGETS, "evaluation_episodes": 1000,
    },
    "sample_efficiency": {
        "agents": ("factored:given",), "seeds": tuple(range(5)), "budgets": tuple(range(20, 201, 20)),
        "evaluation_episodes": 1000, "recorded_episodes": 2,
    },
    "queries": {
        "agents": ("factored:given",), "seeds": tuple(range(5)), "budgets": (10, 20, 30, 40, 60, 80, 100),
        "evaluation_episodes": 100, "execution": "kinematic",
        "open_loop_starts": 0, "recorded_episodes": 0,
    },
}  # fmt: skip
"""The changes of each preset, except where a task has its own: ``smoke`` shows that everything works, ``quick`` is the
default, ``thesis`` is tables 5.1-5.4 as printed, ``full`` has seeds enough to see the filter's gain (5 do not, by the
thesis' own spreads), ``sample_efficiency`` counts the first episodes of agents that need few, ``queries`` does so
in little time, to compare many ways of being taught."""
