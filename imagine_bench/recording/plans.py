"""The recording of plans: the arm carries out blindly a plan that the agent imagined from one frame, both side by side.

Timelines: ``sim_time`` (the arm moves), ``env_step`` (one a macro-action), ``plan``. Entities: ``/scene/...``,
``/real/...``, ``/imagined/...``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import rerun.blueprint as rrb

from imagine_bench.judge.plans import PlanResult, carry_out, make_env
from imagine_bench.recording.filmstrips import DARK, filmstrip
from imagine_bench.recording.stream import Recording, recording_file, scene_view, sheet_view
from imagine_bench.running.trained import Trained

_LOOK_S = 2.0  # how long the scene stands still while the plan is shown, before and after the arm moves
_REAL = ("real_frames", "real_macrostates", "real_rewards", "real_terminated")


def record_plans(trained: Trained, *, count: int, execution: str, max_epistemic: float | None, path: Path) -> Path:
    """Record the first ``count`` plans of :func:`imagine_bench.judge.plans.make_plans`, carried out once more.

    ``path``, which is returned, ends in ``.rrd``.
    """
    task = trained.task

    def layout(recording: Recording) -> rrb.Vertical:
        frames = rrb.Horizontal(
            rrb.Spatial2DView(origin="/real/frame", name="The camera's image (the agent does not see it)"),
            rrb.Spatial2DView(origin="/imagined/frame", name="The agent's imagination of this moment"),
        )
        side = rrb.Vertical(rrb.TextDocumentView(origin="/real/text", name="The plan"), frames)
        top = rrb.Horizontal(scene_view(recording), side, column_shares=[1.1, 1.0])
        strip = sheet_view("/imagined/filmstrip", f"{task.title}: the plan, real above and imagined below")
        return rrb.Vertical(top, strip, row_shares=[1.45, 1.0])

    with closing(make_env(trained, execution)) as env, recording_file(path, task.id, layout, env=env) as recording:
        moments: list[tuple[float, int]] = []

        def arrive(done: int) -> None:
            if done:
                recording.act()
            recording.show()
            moments.append((recording.clock_s, recording.env_step))
            recording.clock_s += _LOOK_S * (done == 0)

        for number in range(count):
            recording.set_clocks(plan=number)
            moments.clear()
            plan = carry_out(env, trained, number, max_epistemic=max_epistemic, on_step=arrive)
            for done, (clock_s, env_step) in enumerate(moments):
                recording.clock_s = clock_s
                recording.set_clocks(env_step=env_step)
                so_far = {name: getattr(plan.compared, name)[:done] for name in _REAL}
                compared = dataclasses.replace(plan.compared, **so_far)
                recording.frames(compared, done, real="/real/frame", imagined="/imagined/frame")
                # room for the longest plan: the viewer takes no images of different sizes
                strip = filmstrip(compared, task.action_names, columns=task.horizon, colors=DARK)
                recording.sheet("/imagined/filmstrip", strip)
                recording.text("/real/text", _words(plan, done, count, task.action_names))
            recording.clock_s += _LOOK_S
    return path


def _words(plan: PlanResult, done: int, count: int, names: Sequence[str]) -> str:
    """The plan, and its outcome when so much is done."""
    lines = [f"### Plan {plan.number} (of {count}, from 0), imagined from one frame", ""]
    for step, action in enumerate(plan.compared.rollout.actions, start=1):
        mark = "done" if step <= done else ("**now**" if step == done + 1 and done < plan.done else "")
        lines.append(f"{step}. {names[int(action)]} {mark}")
    if plan.refused:
        lines += ["", f"**Refused:** {plan.refused}."]
    elif done == plan.done:
        shortest = "none" if plan.shortest is None else plan.shortest
        lines += ["", f"**{plan.outcome[0].upper()}{plan.outcome[1:]}.** The shortest possible: {shortest}."]
    else:
        lines += ["", "The arm does this without looking again."]
    return "\n".join(lines)
