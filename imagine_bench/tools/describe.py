"""What a task is, in a dozen lines, with the exact facts of its rules: ``imagine-bench describe``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

import numpy as np

from imagine_bench import registry
from imagine_bench.exact.certificate import certificate, certificate_rows
from imagine_bench.interfaces import APPEARANCES, EXECUTIONS, TaskSpec, bundled_name
from imagine_bench.rules import evaluate, greedy, is_random, optimal_policy, states_of, tabulate
from imagine_bench.running.bench import task_types
from imagine_bench.running.launchers.jobs import LAUNCHERS
from imagine_bench.store.encoders import bundled
from imagine_bench.sweep.grid import all_grids

_MOST = 10
"""Plan lengths that are listed one by one."""


def describe_task(name: str) -> str:
    """A control or regression task in words and numbers. Raises as :func:`.registry.task`."""
    if name in registry.regressions():
        data = registry.regression(name)
        rows = {"learned from": f"data, in the variants {', '.join(data.variants)}", "error": data.error_name}
        return _page(data.title, data.description, rows)
    spec = registry.task(name)
    facts = spec.facts()
    exact = certificate(spec)
    factors = (f"{n} ({', '.join(v)})" for n, v in zip(spec.macrostate_names, spec.macrostate_values, strict=True))
    chance = "some macro-actions have several outcomes" if is_random(spec.rules) else "none: each has one outcome"
    family, _, options = spec.id.partition(":")  # the family's id needs no look-up first
    made_by = spec.env_id
    if options and registry.has_task(family):
        made_by = f"{registry.task_entry(family).env_id}, with {options.replace(',', ', ')}"
    rows = {
        "Gymnasium id": made_by,
        "observation": f"64 x 64 RGB frame, for encoders preprocessed as {spec.preprocessing}",
        "macro-actions": f"{spec.n_actions}: {'; '.join(spec.action_names)}",
        "macrostate": "; ".join(factors),
        "macrostates": f"{exact.macrostates:,} can come up, {len(spec.rules.start_states):,} of them starts; "
        f"{len(states_of(spec.rules)):,} with those that cannot",
        "chance": chance,
        "horizon": f"{spec.horizon} macro-actions",
        "chance level": f"{100 * facts.chance_level:.1f} % of episodes solved by blind choice",
        "optimum": f"{100 * facts.optimum:.1f} %, with a return of {facts.optimal_return:.2f}",
        "plan lengths": f"{_plan_lengths(spec)}; mean {facts.mean_plan_length:.2f}",
        **certificate_rows(exact),
        "encoders": _encoders(spec),
    }
    return _page(spec.title, spec.description, rows)


def names() -> str:
    """The names of all tasks, agents, presets and so on, one kind a line; then what packages offer in vain."""
    kinds: dict[str, Iterable[str]] = {}
    for name, kind in task_types().items():
        kinds[f"{name} tasks"] = kind.tasks()
        kinds[f"{name} learners"] = kind.learners()
        kinds[f"{name} presets"] = kind.presets
    kinds["grids"] = all_grids()
    kinds["world models"] = registry.world_models()
    kinds["executions"] = EXECUTIONS
    kinds["launchers"] = LAUNCHERS
    kinds["appearances"] = APPEARANCES
    kinds["encoders"] = {**bundled(), **registry.usable(registry.ENCODER_GROUP)}
    lines = [f"{kind:22}{', '.join(members)}" for kind, members in kinds.items()]
    for guest in registry.absent_guests():
        absent = [name for each in guest.names.values() for name in each]
        lines.append(f"{'not installed':22}{', '.join(absent)} ({guest.install})")
    return "\n".join([*lines, *(f"\n{error}" for error in registry.refused_offers())])


def _page(title: str, description: str, rows: dict[str, str]) -> str:
    return "\n".join([title, description, "", *(f"{name:16}{value}" for name, value in rows.items())])


def _plan_lengths(spec: TaskSpec) -> str:
    """Mean macro-actions of the optimal agent, to one decimal, and how many starts need so many."""
    tables = tabulate(spec.rules)
    values = evaluate(tables, greedy(optimal_policy(tables), spec.n_actions), spec.horizon)
    lengths = Counter(np.round(values.length[tables.starts], 1).tolist())
    if len(lengths) > _MOST:
        return f"{min(lengths):g} to {max(lengths):g}"
    return ", ".join(f"{length:g} ({lengths[length]} starts)" for length in sorted(lengths))


def _encoders(spec: TaskSpec) -> str:
    names = [bundled_name(spec.encoder, look, kind) for look in APPEARANCES for kind in ("latents", "codes")]
    return ", ".join(name for name in names if name in bundled()) or "trained on first use"
