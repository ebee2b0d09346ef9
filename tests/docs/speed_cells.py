"""Cells of speed and fidelity: ``make speed``, and ``tests/measure/control_speed.py``; and of models of motions."""

from __future__ import annotations

from typing import Any

import numpy as np
from kept import facts, table

_TASK = "arrow_puzzle: "
_OURS = ("ours", "ours_pick_place")


def speed(machine: str, what: str) -> str:
    """A measured figure of ``make speed``; an en dash where that machine has none."""
    found = [each for each in facts(f"speed/{machine}.json")["figures"] if each["what"].removeprefix(_TASK) == what]
    return (found[0]["measured"] + ("" if found[0]["met"] else ", **missed**")) if found else "–"


def fidelity(world: str, what: str) -> str:
    """A figure of ``speed --worlds`` at clean and at strong, by how its name begins; an en dash where there is none."""
    figures = {each["what"]: each for each in facts("speed/worlds.json")["figures"]}
    starts = [f"{world}{level}: {what}" for level in ("", " at strong")]
    found = [each["measured"] for start in starts for name, each in figures.items() if name.startswith(start)]
    return " / ".join(found) or "–"


def times_ours(peer: str, images: str) -> str:
    """How many times as long a step of another suite takes as ours: in the arrow puzzle / in pick-and-place.

    ``images`` is ``none``, ``one`` or ``two``, without shadows, mirrors and antialiasing, or ``drawn``: one image as
    the other suite draws it. The median over rounds of the ratio within each.
    """
    rounds = facts("speed/control.json")["rounds"]
    theirs = _kind(rounds[0][peer], images)
    ours = _kind(rounds[0][peer], "one" if images == "drawn" else images)
    ratios = [np.median([row[peer][theirs] / row[key][ours] for row in rounds]) for key in _OURS]
    return " / ".join(f"{ratio:.1f}" for ratio in ratios)


def _kind(row: dict[str, Any], images: str) -> str:
    """The key of a step with so many images: one is the hand's, or the front one where no camera is on the hand."""
    if images in {"none", "two"}:
        return {"none": "step_s none", "two": "step_s both-plain"}[images]
    camera = "wrist" if "step_s wrist-plain" in row else "front"
    return f"step_s {camera}" if images == "drawn" else f"step_s {camera}-plain"


def control_step(suite: str, images: str) -> str:
    """CPU ms of a step, the median over rounds."""
    rounds = facts("speed/control.json")["rounds"]
    key = _kind(rounds[0][suite], images)
    return f"{1e3 * np.median([row[suite][key] for row in rounds]):.3g}" if key in rounds[0][suite] else "–"


def control_figure(suite: str, what: str, factor: str = "1") -> str:
    """Another figure of a suite, the median over rounds, times a factor."""
    values = [row[suite][what] for row in facts("speed/control.json")["rounds"]]
    return f"{float(factor) * np.median(values):.3g}"


def control_memory(suite: str) -> str:
    """MiB of a process with one lane, and of each lane more."""
    kept = facts("speed/control.json")["memory"][suite]
    return f"{kept['one_mib']:.0f} + {kept['more_mib']:.0f}"


def control_physics(suite: str) -> str:
    """MuJoCo's version, and physics steps in a step of control."""
    row = facts("speed/control.json")["rounds"][0][suite]
    return f"{row['mujoco']}; {row['physics_steps']} of {row['physics_step_ms']:g} ms"


def beside_mujoco(suite: str, images: str) -> str:
    """How many times as long our step takes as MuJoCo alone, with the absolute figures in us."""
    rounds = facts("speed/control_alone.json")["rounds"]
    parts = ("step_s", "mj_step_s", "mjr_s")
    each = np.array([[row[suite][f"own {part} {images}"] for part in parts] for row in rounds])
    step_us, simulated_us, drawn_us = 1e6 * np.median(each, axis=0)
    ratio = np.median(each[:, 0] / each[:, 1:].sum(axis=1))
    return f"{ratio:.2f} ({step_us:.0f} against {simulated_us:.0f} + {drawn_us:.0f})"


def motion_judged(file: str, model: str, score: str) -> str:
    """A share of the judge of motions, %, or the CPU seconds of a fit: mean (lowest to highest seed)."""
    rows = [row for row in table(f"motion/{file}.csv") if row["model"] == model]
    values = [float(row[score]) for row in rows if row[score]]
    if not values:
        return "–"
    factor = 1.0 if score == "fit_s" else 100.0
    mean, low, high = (f"{factor * each:.0f}" for each in (np.mean(values), min(values), max(values)))
    return mean if low == high or score == "fit_s" else f"{mean} ({low} to {high})"


def tries_done(file: str) -> str:
    """How many of its tries a cloned policy did."""
    counted = facts(f"motion/{file}.json")
    return f"{counted['done']} of {counted['count']}"


def tries_cpu(file: str) -> str:
    """CPU seconds of the training of a cloned policy."""
    return f"{facts(f'motion/{file}.json')['about']['cpu_s']:.0f}"
