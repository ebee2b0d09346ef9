"""Commands: ``python -m imagine_bench_motion`` demonstrate, clone, try, record, flat, level, judge; with ``--help``."""

from __future__ import annotations

import argparse
import hashlib
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from imagine_bench.errors import ImagineBenchError, InvalidValueError
from imagine_bench.registry.machine import describe_environment
from imagine_bench.store.files import require_writable, write_json

from .cloning import Clone, Training, train
from .demonstrations import DemonstrationData, collect
from .judge.command import add_judge
from .skills import FAMILIES, PLACEMENT_M
from .trials import summary, tries

APPEARANCES = ["clean", "mild"]
OBSERVATION = "front,proprio"


def main() -> None:
    """Run the command that was given."""
    parser = argparse.ArgumentParser(prog="python -m imagine_bench_motion", description=__doc__)
    commands = parser.add_subparsers(required=True)
    _add_demonstrate(commands.add_parser("demonstrate", help="let the expert demonstrate single macro-actions"))
    _add_clone(commands.add_parser("clone", help="train a policy on demonstrations"))
    _add_try(commands.add_parser("try", help="count how often a policy carries out single macro-actions"))
    record = commands.add_parser("record", help="record one try of a policy, with the expert's hand beside it")
    _add_record(record)
    _add_flat(commands.add_parser("flat", help="train SAC of Stable-Baselines3 on one cube, without macro-actions"))
    _add_level(commands.add_parser("level", help="train an agent of macro-actions that planner or clone carry out"))
    add_judge(commands.add_parser("judge", help="judge models of motions by the simulator"))
    given = parser.parse_args()
    try:
        given.run(given)
    except ImagineBenchError as error:
        print(error, file=sys.stderr)
        sys.exit(error.exit_code)


def _require_new(file: Path) -> None:
    """Raise InvalidValueError, before long work, where its result would replace another; SetupError as it is said."""
    require_writable(file.parent)
    if file.exists():
        raise InvalidValueError(f"{file} exists; give another file.")


def _add_demonstrate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, help="the .npz file to write")
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--observation", default=OBSERVATION, help="parts, as the environment takes them")
    parser.add_argument("--appearances", nargs="+", default=APPEARANCES)
    parser.add_argument("--family", choices=list(FAMILIES), default="arrows")
    parser.add_argument(
        "--placement", type=float, default=PLACEMENT_M, help="metres that objects start off their slots"
    )
    parser.set_defaults(run=_demonstrate)


def _demonstrate(given: argparse.Namespace) -> None:
    _require_new(given.file)
    began_s = time.process_time()
    data = collect(
        given.count,
        seed=given.seed,
        observation=given.observation,
        appearances=given.appearances,
        family=given.family,
        placement=given.placement,
    )
    data.save(given.file)
    cpu_s = time.process_time() - began_s
    print(f"{data.count} demonstrations, {len(data.episode)} control periods, {cpu_s:.0f} CPU s: {given.file}")


def _add_clone(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("demonstrations", type=Path, help="a file of 'demonstrate'")
    parser.add_argument("file", type=Path, help="the file of the policy to write")
    parser.add_argument(
        "--observation", help="the parts that the demonstrations show; needed for files of old versions"
    )
    parser.add_argument("--first", type=int, help="take only so many demonstrations")
    parser.add_argument("--updates", type=int, default=Training.updates, help="gradient steps")
    parser.add_argument(
        *("--encoder-updates", "--eye-updates"), type=int, default=Training.encoder_updates,
        help="those of the heat maps, before",
    )  # fmt: skip
    parser.add_argument("--shift", type=int, default=Training.shift_px, help="pixels that images are moved by at most")
    parser.add_argument("--chunk", type=int, default=16, help="commands that are predicted at once")
    parser.add_argument("--heat-maps", type=int, default=16, help="points that are looked for in each image")
    parser.add_argument("--seed", type=int, default=0)
    parser.set_defaults(run=_clone)


def _clone(given: argparse.Namespace) -> None:
    _require_new(given.file)
    data = DemonstrationData.load(given.demonstrations)
    if given.first is not None:
        data = data.first(given.first)
    clone = train(
        data,
        seed=given.seed,
        observation=given.observation or data.observation or OBSERVATION,
        settings=Training(updates=given.updates, encoder_updates=given.encoder_updates, shift_px=given.shift),
        layout={"chunk": given.chunk, "heat_maps": given.heat_maps},
        told=lambda update, loss: print(f"{update} updates, loss {loss:.4f}", flush=True),
    )
    clone.save(given.file)
    print(f"{clone.parameters} parameters, {clone.about['cpu_s']:.0f} CPU s: {given.file}")


def _add_try(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, help="a file of 'clone'")
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=77)
    parser.add_argument("--appearances", nargs="+", default=APPEARANCES)
    parser.add_argument("--family", choices=list(FAMILIES), default="arrows")
    parser.add_argument(
        "--placement", type=float, default=PLACEMENT_M, help="metres that objects start off their slots"
    )
    parser.add_argument("--swapped", action="store_true", help="the policy sees the images of another start")
    parser.add_argument("--out", type=Path, help="a .json file for every try")
    parser.set_defaults(run=_try)


def _try(given: argparse.Namespace) -> None:
    clone = Clone.load(given.file)
    if given.out is not None:
        _require_new(given.out)
    began_s = time.process_time()
    found = tries(
        clone,
        given.count,
        seed=given.seed,
        appearances=given.appearances,
        swapped=given.swapped,
        family=given.family,
        placement=given.placement,
    )
    cpu_s = time.process_time() - began_s
    counted = summary(found)
    print(f"{counted['done']} of {counted['count']} done, {cpu_s:.0f} CPU s")
    for name in ("by_appearance", "by_macro_action"):
        print(*(f"  {key}: {done} of {count}" for key, (done, count) in counted[name].items()), sep="\n")
    print(*(f"  failed: {each}" for each in counted["failed"]), sep="\n")
    if given.out is not None:
        commit = describe_environment()["commit"]
        kept = {"about": clone.about, **_asked(given), "clone": kept_name(given.file), "commit": commit, **counted}
        write_json(given.out, kept)


def _add_record(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, help="the .rrd file to write")
    parser.add_argument("--clone", type=Path, help="another file of a clone than the bundled one")
    parser.add_argument("--macro-action", type=int, choices=range(6), default=0)
    parser.add_argument("--seed", type=int, default=0, help="of the start")
    parser.add_argument("--appearance", choices=["clean", "mild", "strong"], default="clean")
    parser.add_argument(
        "--placement", type=float, default=PLACEMENT_M, help="metres that objects start off their slots"
    )
    parser.set_defaults(run=_record)


def _record(given: argparse.Namespace) -> None:
    from .cloned_env import BUNDLED  # noqa: PLC0415 - needs MuJoCo
    from .control.beside_expert import record_beside_expert  # noqa: PLC0415 - needs Rerun

    found = record_beside_expert(
        given.recording,
        Clone.load(given.clone or BUNDLED),
        given.macro_action,
        seed=given.seed,
        appearance=given.appearance,
        placement=given.placement,
    )
    for name, played in (("expert", found.expert), ("clone", found.clone)):
        print(f"{name}: {'done' if played.done else 'not done'}, {played.periods} control periods")
    print(f"their hands are at most {1e3 * found.apart_m.max():.0f} mm apart: {given.recording}")


def _asked(given: argparse.Namespace) -> dict[str, Any]:
    """The options of a command by name, without paths of this machine."""
    left_out = ("run", "out", "file", "clone")
    return {name: value for name, value in vars(given).items() if name not in left_out}


def kept_name(file: Path) -> str:
    """A file as kept results name it: its name, and the start of the SHA-256 of its content."""
    return f"{file.name}@{hashlib.sha256(file.read_bytes()).hexdigest()[:12]}"


def _add_flat(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("out", type=Path, help="the .json file of the curve")
    parser.add_argument("--steps", type=int, default=50_000, help="commands of training")
    parser.add_argument("--every", type=int, default=2_500, help="commands of training before each test")
    parser.add_argument("--reward", choices=["sparse", "dense"], default="sparse")
    parser.add_argument("--settings", choices=["library", "tuned"], default="library", help="of SAC")
    parser.add_argument("--seed", type=int, default=0)
    parser.set_defaults(run=_flat)


def _flat(given: argparse.Namespace) -> None:
    from .flat import Point, learn  # noqa: PLC0415 - needs the library

    def told(point: Point) -> None:
        print(point, flush=True)
        curve.append(asdict(point))
        kept = {**_asked(given), "commit": commit, "curve": curve}
        write_json(given.out, kept)

    _require_new(given.out)
    commit = describe_environment()["commit"]
    curve: list[dict[str, float]] = []
    chosen = {"settings": given.settings, "reward": given.reward}
    learn(given.steps, seed=given.seed, every=given.every, told=told, **chosen)


def _add_level(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("out", type=Path, help="the .json file of the curve")
    parser.add_argument("--agent", required=True, help="of macro-actions, by its registered name; or oracle")
    parser.add_argument("--execution", choices=["planner", "clone"], required=True)
    parser.add_argument("--clone", type=Path, help="another file of a clone than the bundled one")
    parser.add_argument("--cubes", type=int, default=3)
    parser.add_argument("--slip", type=float, default=0.0, help="probability that a grip slips, which no rule declares")
    parser.add_argument("--budgets", type=int, nargs="+", default=[50, 100, 200])
    parser.add_argument("--tests", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.set_defaults(run=_level)


def _level(given: argparse.Namespace) -> None:
    from .cloned_env import BUNDLED  # noqa: PLC0415 - needs MuJoCo
    from .levels import CurvePoint, environment, learn, make_agent, oracle_success  # noqa: PLC0415 - needs MuJoCo

    def told(point: CurvePoint) -> None:
        print(point, flush=True)
        kept["curve"].append(asdict(point))
        write_json(given.out, kept)

    if given.clone is not None and given.execution != "clone":
        raise InvalidValueError("The planner needs no clone; leave out --clone, or give --execution clone.")
    _require_new(given.out)
    world = {"cubes": given.cubes, "slip": given.slip, "clone": given.clone}
    env, test_env = (environment(given.execution, **world) for _ in range(2))
    kept: dict[str, Any] = {**_asked(given), "commit": describe_environment()["commit"], "curve": []}
    if given.execution == "clone":
        kept["clone"] = kept_name(given.clone or BUNDLED)
    rules, horizon = env.rules, env.horizon
    if given.agent == "oracle":
        successes, mean_s = oracle_success(test_env.env, rules, tests=given.tests, horizon=horizon)
        kept |= {"successes": successes, "macro_action_s": round(mean_s, 3)}
        write_json(given.out, kept)
        print(f"{successes} of {given.tests}, {mean_s:.2f} s a macro-action")
        return
    agent = make_agent(given.agent, env.spec, given.seed)
    learn(
        env.env,
        test_env.env,
        agent,
        budgets=given.budgets,
        tests=given.tests,
        horizon=horizon,
        seed=given.seed,
        told=told,
    )


if __name__ == "__main__":
    main()
