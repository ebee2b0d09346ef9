"""The recording of plans: the arm carries out blindly what the agent imagined from one frame, both side by side.

Timelines: ``sim_time`` (the arm moves), ``env_step`` (one a macro-action), ``plan``. Entities: ``/scene/...``,
``/real/...``, ``/imagined/...``.
"""

from __future__ import annotations

import dataclasses
from contextlib import closing
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from imagine_bench.environments import Env
from imagine_bench.interfaces import SceneReader
from imagine_bench.judge.plans import PlanResult, carry_out, make_env
from imagine_bench.recording.episodes import MOTION_HZ
from imagine_bench.recording.filmstrips import filmstrip, rgb
from imagine_bench.recording.scene import (
    log_motion,
    log_shapes,
    look_target_m,
    macro_duration_s,
    playing,
    scene_view,
    sheet_view,
)
from imagine_bench.recording.stream import Recording, recording_file
from imagine_bench.running.trained import Trained
from imagine_bench.store.files import make_folder
from imagine_bench.store.results import ComparedRollout

_LOOK_S = 2.0  # how long the scene stands still while the plan is shown, before and after the arm moves


def record_plans(trained: Trained, *, count: int, execution: str, max_epistemic: float | None, path: Path) -> Path:
    """Record the first ``count`` plans of :func:`imagine_bench.judge.plans.make_plans`, carried out once more.

    ``path``, which is returned, ends in ``.rrd``.
    """
    make_folder(path.parent)
    with closing(make_env(trained, execution)) as env:
        scene = env.unwrapped
        if isinstance(scene, SceneReader):
            scene.capture_motion_hz = MOTION_HZ
        env.reset(seed=0)
        with recording_file(path, trained.task.id, _layout(scene, trained)) as recording:
            if isinstance(scene, SceneReader):
                log_shapes(recording, scene.shapes())
            recorder = _PlanRecorder(
                recording=recording, trained=trained, env=env, count=count, max_epistemic=max_epistemic
            )
            for number in range(count):
                recorder.record(number)
    return path


@dataclasses.dataclass(kw_only=True)
class _PlanRecorder:
    """Records one plan after the other on a common clock."""

    recording: Recording
    trained: Trained
    env: Env
    count: int
    max_epistemic: float | None
    clock_s: float = 0.0
    env_step: int = 0

    def record(self, number: int) -> None:
        """One plan: the scene stands, the plan appears, the arm does it, and its outcome is shown."""
        scene = self.env.unwrapped
        self.recording.stream.set_time("plan", sequence=number)
        moments: list[tuple[float, int]] = []

        def arrive(done: int) -> None:
            if done:
                self.clock_s += macro_duration_s(scene)
                self.env_step += 1
            self.recording.set_clocks(self.clock_s, env_step=self.env_step)
            if isinstance(scene, SceneReader):
                sequences = {"env_step": self.env_step, "plan": number}
                log_motion(self.recording, scene.motion(), end_s=self.clock_s, sequences=sequences)
            moments.append((self.clock_s, self.env_step))
            self.clock_s += _LOOK_S * (done == 0)

        plan = carry_out(self.env, self.trained, number, max_epistemic=self.max_epistemic, on_step=arrive)
        for done, (clock_s, env_step) in enumerate(moments):
            self.recording.set_clocks(clock_s, env_step=env_step)
            self._show(plan, done)
        self.clock_s += _LOOK_S
        self.env_step += 1

    def _show(self, plan: PlanResult, done: int) -> None:
        """What was imagined, and what is real so far."""
        recording = self.recording
        compared = plan.compared
        rollout = plan.compared.rollout
        real = compared.start_frame if done == 0 else compared.real_frames[done - 1]
        imagined = rollout.start_frame if done == 0 else rollout.frames[done - 1]
        recording.log("/real/frame", rr.Image(real))
        recording.log("/imagined/frame", rr.Image(rgb(imagined)))
        task = self.trained.task  # room for the longest plan: the viewer takes no images of different sizes
        strip = filmstrip(_so_far(compared, done), task.action_names, columns=task.horizon)
        recording.sheet("/imagined/filmstrip", strip)
        recording.text("/real/text", self._words(plan, done))

    def _words(self, plan: PlanResult, done: int) -> str:
        names = self.trained.task.action_names
        lines = [f"### Plan {plan.number} (of {self.count}, from 0), imagined from one frame", ""]
        for step, action in enumerate(plan.compared.rollout.actions, start=1):
            mark = "done" if step <= done else ("**now**" if step == done + 1 and done < plan.done else "")
            lines.append(f"{step}. {names[int(action)]} {mark}")
        if plan.refused:
            lines += ["", f"**Refused:** {plan.refused}."]
        elif done == plan.done:
            lines += ["", f"**{plan.outcome[0].upper()}{plan.outcome[1:]}.** The shortest possible: {plan.shortest}."]
        else:
            lines += ["", "The arm does this without looking again."]
        return "\n".join(lines)


def _so_far(compared: ComparedRollout, done: int) -> ComparedRollout:
    """The comparison when ``done`` macro-actions are carried out."""
    names = ("real_frames", "real_macrostates", "real_rewards", "real_terminated")
    return dataclasses.replace(compared, **{name: getattr(compared, name)[:done] for name in names})


def _layout(scene: Env, trained: Trained) -> rrb.Blueprint:
    frames = rrb.Horizontal(
        rrb.Spatial2DView(origin="/real/frame", name="What the camera sees (the agent does not)"),
        rrb.Spatial2DView(origin="/imagined/frame", name="What the agent imagined for this moment"),
    )
    text = rrb.TextDocumentView(origin="/real/text", name="The plan")
    top = rrb.Horizontal(scene_view(look_target_m(scene)), rrb.Vertical(text, frames), column_shares=[1.1, 1.0])
    strip = sheet_view("/imagined/filmstrip", f"{trained.task.title}: the plan, real above and imagined below")
    return playing(rrb.Vertical(top, strip, row_shares=[1.45, 1.0]))
