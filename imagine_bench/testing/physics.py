"""``imagine-bench check TASK --physics``: does physics follow the rules, and how nearly does it fail?

Fidelity is measured on long random walks beside a perfect execution. Margins are how far each setting that makes a
grasp hold may go before macro-actions fail.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import scipy  # its parts load, slowly, when they are first used

from imagine_bench import registry, statistics
from imagine_bench.appearance import appearance_name
from imagine_bench.arrays import Bools, Floats, State
from imagine_bench.errors import InvalidValueError, require
from imagine_bench.exact import motion
from imagine_bench.interfaces import APPEARANCES, SENSES, PhysicsSettings, TaskSpec
from imagine_bench.registry.machine import describe_environment, gl_renderer
from imagine_bench.rules import states_of_play
from imagine_bench.seeding import SeedTree, episode_seed
from imagine_bench.store.files import read_json, require_writable, write_json
from imagine_bench.values import Json

if TYPE_CHECKING:
    from imagine_bench.tasks.continuous.env import MotionEnv

SWEEPS: dict[str, tuple[float, ...]] = {
    "pad_friction": (1.2, 0.6, 0.3, 0.2, 0.1, 0.05, 0.03, 0.01, 0.003, 0.001),
    "finger_force_n": (30, 10, 5, 3, 2, 1.5, 1, 0.9, 0.7, 0.5, 0.3, 0.1),
    "object_mass": (1, 3, 5, 10, 15, 20, 30, 35, 40, 60),
    "plan_error_mm": (0, 2, 4, 6, 8, 10, 12, 14, 17, 20, 25, 30, 40),
    "plan_error_deg": (0, 5, 10, 15, 20, 25, 30, 32, 35, 40, 45),
}
"""Values of each setting, the first as built. Beyond 45 degrees a cube looks as if turned the other way."""
HEAD = "| what | required | measured | |\n|---|---|---|---|"
"""Head of a table of figures."""
_CLEAN = APPEARANCES[0]
_RIGHT = 0.99  # of planned macro-actions in continuous control
_BLOCK = 500  # random episodes between two writes
_ACTIONS_A_WALK = 200  # between two resets: errors may accumulate
_ACTIONS_A_VARIED_WALK = 5  # where poses vary, a turn undoes the draw of the reset
_WALKS = 5  # without a reset, of each way to sense poses
_WALK_ACTIONS = 200
_STANDS_M = 0.02  # an object so near to its height on the table stands there
_QUARTER_DEG = 90.0
_SLIPPED_MM = 5  # an object whose macro-action slips is only squared in the fingers, and moves less than a pushed one
_SIGNS = {"<": operator.lt, "<=": operator.le, ">=": operator.ge}


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One measured figure: its name with the unit, its target and value as text, and whether the target is met."""

    what: str
    required: str  #: An en dash if there is no target
    measured: str
    met: bool

    @property
    def row(self) -> str:
        """Its row of a Markdown table."""
        verdict = "" if self.required == "–" else "met" if self.met else "NOT MET"
        return f"| {self.what} | {self.required} | {self.measured} | {verdict} |"


def figure_of(
    what: str, value: float, form: str, sign: str = "", target: float | None = None, more: str = ""
) -> Figure:
    """A figure whose value must stand to its target as ``sign`` says (``"<"``, ``"<="`` or ``">="``), if it has one.

    ``form`` formats the value, and ``more`` follows it.
    """
    measured = f"{value:{form}}{more}"
    if target is None:
        return Figure(what=what, required="–", measured=measured, met=True)
    required = f"{target:.1%}" if form.endswith("%") else f"{target:,g}"
    return Figure(what=what, required=f"{sign} {required}", measured=measured, met=bool(_SIGNS[sign](value, target)))


def check_physics(
    task: str,
    out: Path,
    *,
    turns: int = 2_000,
    trials: int = 200,
    appearances: Sequence[str] = (_CLEAN,),
) -> bool:
    """Measure fidelity and margins of a task, print Markdown tables, keep the figures and the machine's description.

    Args:
        task: Registered task, this suite's or an installed package's.
        out: The JSON file to write.
        turns: Macro-actions of the fidelity measurement at each appearance; 0 for none.
        trials: Macro-actions of each value of each physics setting; 0 for none.
        appearances: Appearance levels at which fidelity is measured.

    Returns:
        Whether every target of the task was met; a task without targets is only measured.

    Raises:
        InvalidValueError: Negative or no numbers of macro-actions, or a folder to write to.
        UnknownNameError: An unknown task or appearance.
        SetupError: The file cannot be written, or there is no GL.
    """
    if min(turns, trials) < 0 or turns == trials == 0:
        raise InvalidValueError(f"turns is {turns} and trials is {trials}; give at least 1 macro-action of either.")
    if out.is_dir():
        raise InvalidValueError(f"{out} is a folder; give the JSON file to write.")
    spec = registry.task(task)
    if {"physics", "kinematic"} - set(spec.executions):
        raise InvalidValueError(f"{task} has the executions {spec.executions}; physics is compared with kinematic.")
    levels = [appearance_name(each) for each in appearances]
    require_writable(out.parent)
    gl_renderer()  # fails here, in one sentence, rather than in a macro-action
    kept: dict[str, Json] = {"task": spec.id, "seed": 0}
    figures = []
    if turns:
        print(HEAD)
        for level in levels:
            for figure in fidelity_figures(spec, turns, level):
                figures.append(figure)
                print(figure.row)
        kept["figures"] = [asdict(figure) for figure in figures]
    if trials:
        kept |= measure_margins(spec, trials)
    write_json(out, {**kept, "environment": describe_environment()})
    return all(figure.met for figure in figures)


def check_motion(
    name: str, out: Path, *, turns: int, trials: int, random_episodes: int, appearances: Sequence[str]
) -> bool:
    """Measure how far a task of continuous control can be solved, print it, and keep it.

    Args:
        name: The task as commands name it, such as ``"ArrowPuzzleMotion"``.
        out: The JSON file to write. Without segments it is one of an earlier call, to which random episodes are added.
        turns: Macro-actions of whole episodes of planned motions.
        trials: Segments: single planned macro-actions. 0 to keep those of ``out``.
        random_episodes: Episodes of random hand twists, at the first appearance alone, of the seeds 0, 1, 2 and so on.
            The file is written after every 500, and those that it has are not played again.
        appearances: Appearance levels.

    Returns:
        Whether at least 99 % of the segments were as ruled.

    Raises:
        InvalidValueError: A negative number, or a folder to write to.
        UnknownNameError: An unknown task or appearance.
        ArtefactError: Without segments: the file is missing, or not of this task and appearance.
        SetupError: The file cannot be written.
    """
    if min(trials, turns, random_episodes) < 0 or out.is_dir():
        numbers = f"trials is {trials}, turns {turns}, random {random_episodes}"
        raise InvalidValueError(f"{numbers} and the file {out}; give numbers from 0 and a JSON file.")
    task = registry.task_of_motion(name) or name
    entry = registry.task_entry(task)
    spec = registry.task(task)
    levels = [appearance_name(each) for each in appearances]
    require_writable(out.parent)

    def make(level: str) -> MotionEnv:
        return registry.load(entry.motion)(**entry.options, appearance=level, observation="proprio")

    for level in levels:
        make(level).close()  # a level that is refused is so before anything is measured
    if trials:
        document: dict[str, Any] = {"task": spec.id, "seed": 0}
        document["appearances"] = _segments(make, levels, trials, turns)
        document["environment"] = describe_environment()
        write_json(out, document)
    else:
        document = read_json(out, "measurements of continuous control")
        known = document.get("appearances", {})
        levels = levels[:1]
        require(
            document.get("task") == spec.id and levels[0] in known,
            f"{out} has measurements of {document.get('task')} at {', '.join(known)}, not of {spec.id} at {levels[0]}.",
        )
    with closing(make(levels[0])) as env:
        _add_random_episodes(env, document, document["appearances"][levels[0]], random_episodes, out)
    right = True
    for level in levels:
        found = motion.certificate(spec, document["appearances"][level])
        right &= found.as_ruled >= _RIGHT * found.segments
        print(f"{level}: shown reachable {found.shown:.2%}; {motion.evidence(found)}; {motion.chance(found)}")
        for reason, count in document["appearances"][level]["faults"].items():
            print(f"  {count} times: {reason}")
    return right


def _segments(make: Callable[[str], MotionEnv], levels: Sequence[str], trials: int, turns: int) -> dict[str, Any]:
    """The segments and whole episodes of a task at each appearance."""
    measure = registry.load("imagine_bench.tasks.continuous.segments:measure")
    kept = {}
    for level in levels:
        with closing(make(level)) as env:
            kept[level] = asdict(measure(env, tries=trials, turns=turns))
    return kept


def _add_random_episodes(env: MotionEnv, document: dict[str, Any], kept: dict[str, Any], until: int, out: Path) -> None:
    """Play random episodes of the seeds that were not played yet, and keep their count in blocks."""
    random_episode = registry.load("imagine_bench.tasks.continuous.segments:random_episode")
    if kept["random_episodes"] < until:
        document["random_environment"] = describe_environment()
    for begin in range(kept["random_episodes"], until, _BLOCK):
        end = min(until, begin + _BLOCK)
        kept["random_solved"] += sum(random_episode(env, seed) for seed in range(begin, end))
        kept["random_episodes"] = end
        write_json(out, document)


def make_env(spec: TaskSpec, **options: Any) -> Any:
    """The task's environment itself, without Gymnasium's wrappers; keywords as for ``gymnasium.make``."""
    return gymnasium.make(spec.env_id, **options, disable_env_checker=True).unwrapped


# Fidelity ----------------------------------------------------------------------------------------------------------


def fidelity_figures(spec: TaskSpec, turns: int, appearance: str = _CLEAN) -> Iterator[Figure]:
    """Fidelity of random macro-actions, beside the task's targets if it has any."""
    targets = spec.targets
    found = measure_fidelity(spec, turns, appearance)
    world = spec.id if appearance == _CLEAN else f"{spec.id} at {appearance}"
    what = f"{world}: macro-actions exactly as the rules say, of {turns:,}"
    if targets is None:
        yield figure_of(what, found.as_ruled / found.actions, ".2%")
    else:
        least = targets.as_ruled if appearance == _CLEAN else targets.as_ruled_varied
        yield figure_of(what, found.as_ruled / found.actions, ".2%", ">=", least)
        what = f"{world}: other objects moved, worst, mm"
        yield figure_of(what, found.other_objects_mm, ".3f", "<", targets.other_objects_mm)
        for what, values, most in (
            ("position error, p99, mm", found.error_mm, targets.error_mm),
            ("yaw error, p99, degrees", found.error_deg, targets.error_deg),
        ):
            if most is not None:
                yield figure_of(f"{world}: {what}", float(np.percentile(values, 99)), ".2f", "<", most)
    if found.slips:
        yield from slips(world, found)


@dataclass
class Fidelity:
    """The results of a walk."""

    actions: int = 0  #: macro-actions done
    faults: list[str] = field(default_factory=list)  #: why some did not end as the rules say
    other_objects_mm: float = 0.0  #: the furthest that an object moved which the action should leave where it stood
    #: Of each object acted on, its distance from where a perfect execution leaves it.
    error_mm: list[float] = field(default_factory=list)
    #: Its yaw from there, to the nearest quarter turn, since objects have no marked side.
    error_deg: list[float] = field(default_factory=list)
    #: Of each macro-action that might slip: whether it did, and the probability that the rules gave to that.
    slips: list[tuple[bool, float]] = field(default_factory=list)
    slipped_mm: float = 0.0  #: the furthest that an object moved whose macro-action slipped

    @property
    def as_ruled(self) -> int:
        """Macro-actions that ended as the rules say, without a fault."""
        return self.actions - len(self.faults)


def measure_fidelity(spec: TaskSpec, actions: int, appearance: str = _CLEAN) -> Fidelity:
    """Walk at random in contact physics, judged by the objects' poses in the simulation and not by ``info`` alone.

    Of a task without ``targets`` no object is known, and ``info`` alone judges.

    Args:
        spec: The task.
        actions: Macro-actions of the measurement.
        appearance: Says how far from their places a reset puts objects.
    """
    objects = () if spec.targets is None else spec.targets.objects
    goes_on = spec.targets is not None and spec.targets.goes_on
    real, perfect = (make_env(spec, execution=each, appearance=appearance) for each in ("physics", "kinematic"))
    found = Fidelity(actions=actions)
    rng = SeedTree(0).child("speed", "physics", spec.id).generator()
    walk_actions = _ACTIONS_A_WALK if appearance == _CLEAN else _ACTIONS_A_VARIED_WALK
    play = states_of_play(spec.rules)
    real.reset(seed=episode_seed("tuning", 0, actions))
    standing_m = _poses(real, objects)[:, 2]  # every start has all objects on the table
    fresh = True
    for step in range(actions):
        if fresh or step % walk_actions == 0:
            options = {"macrostate": play[int(rng.integers(len(play)))]}
            for env in (perfect, real):
                _, info = env.reset(seed=episode_seed("tuning", 0, step), options=options)
        before = _poses(real, objects)
        state = info["macrostate"]
        action = int(rng.integers(spec.n_actions))
        *_, wanted = perfect.step(action)
        _, _, terminated, _, info = real.step(action)
        right = not info["fault"] and np.array_equal(info["macrostate"], wanted["macrostate"])
        if right:
            outcomes = spec.rules.outcomes(tuple(state.tolist()), action)
            can_move = np.array([state != each.macrostate for each in outcomes])[:, : len(objects)]
            moved = np.not_equal(state, info["macrostate"])[: len(objects)]
            slip = sum(each.probability for each, moves in zip(outcomes, can_move, strict=True) if not moves.any())
            if 0 < slip < 1:
                found.slips.append((not moved.any(), slip))
            poses = np.array([before, _poses(real, objects), _poses(perfect, objects)])
            _compare(found, moved, np.logical_or.reduce(can_move), standing_m, poses)
        else:
            found.faults.append(info.get("fault_reason", f"{wanted['macrostate']} was to be reached"))
        fresh = not right or (terminated and not goes_on)
    for env in (real, perfect):
        env.close()
    return found


def _poses(env: Any, objects: Sequence[str]) -> Floats:
    """Positions and quaternions of the named bodies, now. Shape (N, 7)."""
    if not objects:
        return np.empty((0, 7))
    motion = env.motion()
    return motion.poses_in_world[-1][[motion.body_names.index(name) for name in objects]]


def _compare(found: Fidelity, moved: Bools, can_move: Bools, standing_m: Floats, poses: Floats) -> None:
    """Take in where the N objects are after a macro-action that ended as the rules say.

    Args:
        found: Changed in place.
        moved: Objects whose coordinate changed. Shape (N,).
        can_move: Objects that the action can move. Shape (N,).
        standing_m: Height of each on the table. Shape (N,).
        poses: Poses before the action, after it, and after a perfect execution. Shape (3, N, 7).
    """
    before, after, perfect = poses
    stood = (np.abs(poses[:2, :, 2] - standing_m) < _STANDS_M).all(axis=0)
    shifts_mm = 1e3 * (after - before)[:, :3]
    others_mm = np.abs(shifts_mm[stood & ~can_move]).max(initial=0.0)
    found.other_objects_mm = max(found.other_objects_mm, float(others_mm))
    if not moved.any():
        slipped_mm = np.linalg.norm(shifts_mm[can_move], axis=1).max(initial=0.0)
        found.slipped_mm = max(found.slipped_mm, float(slipped_mm))
    found.error_mm += (1e3 * np.linalg.norm((after - perfect)[moved, :3], axis=1)).tolist()
    off_deg = (_yaw_deg(after) - _yaw_deg(perfect) + _QUARTER_DEG / 2) % _QUARTER_DEG - _QUARTER_DEG / 2
    found.error_deg += np.abs(off_deg[moved]).tolist()


def _yaw_deg(poses: Floats) -> Floats:
    """Yaw of poses (N, 7), each a position and a quaternion w x y z, about the world's vertical. Shape (N,)."""
    w, x, y, z = poses[:, 3:].T
    return np.degrees(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def slips(world: str, found: Fidelity) -> Iterator[Figure]:
    """The rate of slips, within the 99 % interval of the rules' probability, and how far objects that slip move."""
    n = len(found.slips)
    rate, expected = np.mean(found.slips, axis=0)
    low, high = scipy.stats.binom.interval(0.99, n, expected) / np.float64(n)
    yield Figure(
        what=f"{world}: macro-actions that slip, of {n:,}",
        required=f"{low:.1%} to {high:.1%}",
        measured=f"{rate:.1%}",
        met=bool(low <= rate <= high),
    )
    yield figure_of(f"{world}: objects that slip move, worst, mm", found.slipped_mm, ".2f", "<", _SLIPPED_MM)


# Margins -----------------------------------------------------------------------------------------------------------


def measure_margins(spec: TaskSpec, trials: int) -> dict[str, Json]:
    """Sweep each setting alone, walk with true and nominal poses, print a Markdown table and return the figures.

    A task whose environment takes no ``physics`` has none, nor has one in which grips slip by chance. A trial is one
    macro-action from a start that moves an object if it succeeds. The same starts, actions and seeds serve every value.
    """
    if not all(_moves(spec, start) for start in spec.rules.start_states):
        print(f"No margins: in {spec.id} no macro-action is certain to move an object, as where grips slip by chance.")
        return {}
    try:
        make_env(spec, physics=PhysicsSettings()).close()
    except TypeError:  # Gymnasium's, for a keyword that the environment does not take
        print(f"No margins: the environment of {spec.id} takes no physics settings.")
        return {}
    print("| setting | value | as ruled | 95 % (Wilson) |\n|---|---|---|---|")
    curves: dict[str, list[dict[str, float]]] = {name: [] for name in SWEEPS}
    for name, values in SWEEPS.items():
        for value in values:
            right = as_ruled(spec, PhysicsSettings.of({name: float(value)}), trials)
            low, high = statistics.wilson(right, trials)
            point = {"value": float(value), "as_ruled": right, "trials": trials, "low": low, "high": high}
            curves[name].append(point)
            print(f"| {name} | {value:g} | {right} of {trials} | {low:.3f} to {high:.3f} |")
    walks = [walk(spec, sense) for sense in SENSES]
    for each in walks:
        print(f"| sense | {each['sense']} | {each['as_ruled']} of {each['actions']} | {len(each['faults'])} faults |")
    return {"built": asdict(PhysicsSettings()), "curves": curves, "walks": walks}


def as_ruled(spec: TaskSpec, settings: PhysicsSettings, trials: int) -> int:
    """How many of so many macro-actions end as the rules say and without a fault."""
    env = make_env(spec, physics=settings)
    rng = SeedTree(0).child("margins", spec.id).generator()
    starts = spec.rules.start_states
    right = 0
    for trial in range(trials):
        start = starts[int(rng.integers(len(starts)))]
        action = int(rng.choice(_moves(spec, start)))
        env.reset(seed=episode_seed("tuning", 0, trial), options={"macrostate": start})
        *_, info = env.step(action)
        right += not info["fault"]
    env.close()
    return right


def walk(spec: TaskSpec, sense: str) -> dict[str, Any]:
    """Walk at random, without a reset, among actions that move an object and leave one to move; a fault ends a walk.

    Returns:
        The sense; macro-actions done, and as ruled; of each walk its length and the fault that ended it early; and in
        mm the furthest that a standing object came from where it stood at first.
    """
    env = make_env(spec, physics=PhysicsSettings(sense=sense))
    rng = SeedTree(0).child("margins", "walk", spec.id).generator()
    lengths = []
    faults = []
    drift_m = 0.0
    for number in range(_WALKS):
        _, info = env.reset(seed=episode_seed("tuning", 1, number))
        at_first = env.world.object_poses()
        length = 0
        while length < _WALK_ACTIONS and not info["fault"]:
            state = tuple(info["macrostate"].tolist())
            going_on = [a for a in _moves(spec, state) if all(_moves(spec, then) for then in _after(spec, state, a))]
            *_, info = env.step(int(rng.choice(going_on)))
            length += 1
            off_m = env.world.object_poses() - at_first  # [N, 7]
            standing = (np.abs(off_m[:, 2]) < _STANDS_M) & (not info["fault"])  # [N]
            drift_m = max(drift_m, float(np.linalg.norm(off_m[standing, :2], axis=1).max(initial=0.0)))
        lengths.append(length)
        if info["fault"]:
            faults.append(info.get("fault_reason", "not named"))
    env.close()
    done = {"sense": sense, "actions": sum(lengths), "as_ruled": sum(lengths) - len(faults)}
    return {**done, "lengths": lengths, "faults": faults, "drift_mm": 1e3 * drift_m}


def _after(spec: TaskSpec, state: State, action: int) -> list[State]:
    return [outcome.macrostate for outcome in spec.rules.outcomes(state, action)]


def _moves(spec: TaskSpec, state: State) -> Sequence[int]:
    """Actions that change an object's coordinate, whatever people answer; people's is the last one."""
    n = len(state) - 1
    return [a for a in range(spec.n_actions) if all(then[:n] != state[:n] for then in _after(spec, state, a))]
