"""Pictures of several imagined sampled_rollouts of the same beginning (after the thesis' figure 3.4)."""

from __future__ import annotations

import textwrap

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from imagine_bench.interfaces import Rules, TaskSpec
from imagine_bench.judge.filmstrips import FAINT, INK, PAPER, RIGHT, WRONG, font, rgb
from imagine_bench.store.results import ComparedRollout

_CELL, _GAP, _MARGIN = 128, 14, 12  # pixels
_HEAD, _FOOT, _WORDS = 36, 54, 20


def courses_sheet(sampled_rollouts: tuple[ComparedRollout, ...], spec: TaskSpec) -> NDArray[np.uint8]:
    """Draw imagined sampled_rollouts one below the other, a column a macro-action; the real start is the only real picture.

    Below each imagined picture stands what a probe says has changed: in blue where the rules make it possible, in
    orange where not.

    Args:
        sampled_rollouts: Several rollouts from one beginning, at least one.
        spec: Names macro-actions and macrostates.

    Returns:
        The picture. Shape (height, width, 3), uint8.
    """
    depth = max(len(each.rollout.actions) for each in sampled_rollouts)
    row_height = _HEAD + _CELL + _FOOT + _GAP
    size = (2 * _MARGIN + (depth + 1) * (_CELL + _GAP), 2 * _MARGIN + len(sampled_rollouts) * row_height)
    canvas = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(canvas)
    for row, course in enumerate(sampled_rollouts):
        top = _MARGIN + row * row_height
        if row == 0:
            _cell(canvas, 0, top, course.start_frame)
            draw.text((_left(0), top + _HEAD - 18), "the real start", font=font(12, bold=True), fill=INK)
        else:
            draw.text((_left(0), top + _HEAD + 40), "the same start,\nimagined again", font=font(12), fill=FAINT)
        for step in range(len(course.rollout.actions)):
            _imagined(canvas, draw, course, step, top, spec)
    return np.asarray(canvas)


def _imagined(
    canvas: Image.Image, draw: ImageDraw.ImageDraw, course: ComparedRollout, step: int, top: int, spec: TaskSpec
) -> None:
    rollout, left = course.rollout, _left(step + 1)
    before = course.start_macrostate if step == 0 else rollout.macrostates[step - 1]
    now = rollout.macrostates[step]
    title = textwrap.wrap(spec.action_names[int(rollout.actions[step])], width=_WORDS)[:2]
    draw.multiline_text((left, top), "\n".join(title), font=font(11, bold=True), fill=INK, spacing=2)
    _cell(canvas, step + 1, top, rgb(rollout.frames[step]))
    end = "; the end" if rollout.p_terminated[step] > 0.5 else ""
    words = textwrap.wrap(changes(before, now, spec) + end, width=_WORDS)[:3]
    color = RIGHT if is_possible(spec.rules, before, int(rollout.actions[step]), now) else WRONG
    draw.multiline_text((left, top + _HEAD + _CELL + 3), "\n".join(words), font=font(11), fill=color, spacing=2)


def changes(before: NDArray[np.int64], now: NDArray[np.int64], spec: TaskSpec) -> str:
    """What is different, in the task's own words."""
    named = zip(spec.macrostate_names, spec.value_names(now), before, now, strict=True)
    parts = [f"{name} {value}" for name, value, was, after in named if was != after]
    return ", ".join(parts) or "nothing changes"


def is_possible(rules: Rules, before: NDArray[np.int64], action: int, now: NDArray[np.int64]) -> bool:
    """Whether the rules allow ``now`` after ``action`` in ``before``."""
    state, reached = tuple(before.tolist()), tuple(now.tolist())
    known = state in rules.states and not rules.is_terminal(state)
    return known and any(outcome.macrostate == reached for outcome in rules.outcomes(state, action))


def _left(column: int) -> int:
    return _MARGIN + column * (_CELL + _GAP)


def _cell(canvas: Image.Image, column: int, top: int, pixels: NDArray[np.uint8]) -> None:
    image = Image.fromarray(pixels).resize((_CELL, _CELL), Image.Resampling.NEAREST)
    canvas.paste(image, (_left(column), top + _HEAD))
